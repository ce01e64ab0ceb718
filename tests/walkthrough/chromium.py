"""A headless Chromium on a pipe: open a page at a size, ask it things, press and drag, and take its picture."""

from __future__ import annotations

import base64
import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from pop_ref.walkthrough.builder.command import CHROMIUM_OPTIONS as OPTIONS
from tests.app.browser import Browser, browser

# where pictures are kept to be looked at
SCREENSHOTS = os.environ.get("POP_SCREENSHOTS")
CODES = {"ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40, "Home": 36, "End": 35, "Enter": 13, " ": 32}


def keep(png: bytes, name: str) -> None:
    """Write a picture into the folder that the environment's `POP_SCREENSHOTS` names, if it names one."""
    if SCREENSHOTS:
        Path(SCREENSHOTS).mkdir(parents=True, exist_ok=True)
        (Path(SCREENSHOTS) / name).write_bytes(png)


@contextmanager
def opened() -> Iterator[Page]:
    """Start a browser and give its tab, or skip the test with the reason."""
    profile = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
    with profile as folder, browser(Path(folder), Page, OPTIONS) as page:
        yield page


class Page(Browser):
    """One tab. Everything that the page logs or throws is kept in `complaints`."""

    def __init__(self, to: BinaryIO, back: BinaryIO) -> None:
        self.complaints: list[str] = []
        super().__init__(to, back)
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def open(
        self,
        path: Path,
        width: int = 900,
        height: int = 800,
        dark: bool = False,
        scripts: bool = True,
        fragment: str = "",
    ) -> None:
        """Open a file, which is not open yet, at a fragment; wait until it is there and has been drawn."""
        self.complaints.clear()
        self.call("Emulation.setScriptExecutionDisabled", value=not scripts)
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Emulation.setTouchEmulationEnabled", enabled=width < 600)
        self._prefer(dark)
        loader = self.call("Page.navigate", url=path.as_uri() + fragment)["loaderId"]
        while (told := self._receive()).get("method") != "Page.lifecycleEvent" or (
            told["params"]["name"] != "load" or told["params"]["loaderId"] != loader
        ):
            pass
        if scripts:
            self._wait_for_frames()

    def switch(self, dark: bool) -> None:
        """Let the reader prefer dark pages, or light ones, from now on, and wait until the page is drawn so."""
        self._prefer(dark)
        self._wait_for_frames()

    def ask(self, expression: str) -> Any:
        """Evaluate JavaScript in the page and return its value; a promise is waited for."""
        told = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in told:
            raise RuntimeError(told["exceptionDetails"]["exception"].get("description", expression))
        return told["result"].get("value")

    def press(self, key: str) -> None:
        """Press and release a key where the focus is."""
        for kind in ("keyDown", "keyUp"):
            text = {"text": "\r"} if key == "Enter" and kind == "keyDown" else {}
            text = {"text": key} if len(key) == 1 and kind == "keyDown" else text
            code = CODES.get(key, ord(key[0].upper()))
            self.call("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code, **text)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at one place of the window and let it go at another."""
        (x0, y0), (x1, y1) = start, end
        self.call("Input.dispatchMouseEvent", type="mousePressed", x=x0, y=y0, button="left", buttons=1, clickCount=1)
        for t in (0.5, 1.0):
            place = {"x": x0 + t * (x1 - x0), "y": y0 + t * (y1 - y0)}
            self.call("Input.dispatchMouseEvent", type="mouseMoved", button="left", buttons=1, **place)
        self.call("Input.dispatchMouseEvent", type="mouseReleased", x=x1, y=y1, button="left", clickCount=1)

    def touch(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Put a finger down at one place, lift it at another, and wait until the page has heard of it."""
        # the protocol's answer may come before the page's own listeners have run
        heard = "['touchend', 'touchcancel'].forEach(kind => addEventListener(kind, () => done(1), {once: true}))"
        self.ask(f"window.lifted = new Promise(done => {heard}), 1")
        for kind, points in (("touchStart", [start]), ("touchMove", [end]), ("touchEnd", [])):
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y} for x, y in points])
        self.ask("window.lifted")

    def picture(self, selector: str = "body") -> bytes:
        """Take the picture of an element, as PNG."""
        script = "(({x, y, width, height}) => ({x: x + scrollX, y: y + scrollY, width, height}))"
        box = self.ask(f"{script}(document.querySelector({json.dumps(selector)}).getBoundingClientRect())")
        shot = self.call("Page.captureScreenshot", clip={**box, "scale": 1}, captureBeyondViewport=True)
        return base64.b64decode(shot["data"])

    def _prefer(self, dark: bool) -> None:
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])

    def _wait_for_frames(self) -> None:
        self.ask("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))")

    def _receive(self) -> dict[str, Any]:
        told = super()._receive()
        match told.get("method"), told.get("params"):
            case "Runtime.exceptionThrown", {"exceptionDetails": details}:
                self.complaints.append(details.get("exception", {}).get("description", details["text"]))
            case "Runtime.consoleAPICalled", {"type": "error" | "warning", "args": args}:
                self.complaints.append(str([each.get("value") for each in args]))
            case "Log.entryAdded", {"entry": entry}:
                self.complaints.append(entry["text"])
        return told
