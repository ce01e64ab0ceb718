"""A headless Chromium over the DevTools protocol on two pipes: tabs that show a page and hand back pictures of it.

`Browser` is a tab for whoever looks at a page that draws by WebGL. `Page`, whose tab `opened` gives, is for the pages
of the walk-through: its reader presses keys, drags, and prefers dark pages.
"""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import pytest

from pop_ref.walkthrough.builder.command import CHROMIUM_OPTIONS

_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
)
_PATIENCE = 120.0


def find_chromium() -> str:
    """Return the browser's path, or skip the test with the reason."""
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if found is None:
        pytest.skip("no chromium on the PATH; apt-get install chromium")
    return found


class Browser:
    """A tab. `requests` lists what it asked of any network."""

    def __init__(self, to: BinaryIO, back: BinaryIO) -> None:
        self._to, self._back, self._rest = to, back, b""
        self._number, self._session = 0, None
        self.requests: list[str] = []
        self.errors: list[str] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and wait for its answer."""
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session is not None:
            message["sessionId"] = self._session
        self._to.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.errors.append(json.dumps(answer["params"])[:500])
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            part = self._back.read(1 << 20)
            assert part, "the browser has ended"
            self._rest += part
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def open(self, page: Path, width: int, height: int, fragment: str = "") -> None:
        """Show a page in a window of this size, px."""
        self.show(f"{page.as_uri()}{fragment}", width, height)

    def show(self, url: str, width: int, height: int) -> None:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str) -> None:
        until = time.monotonic() + _PATIENCE
        while not self.value(expression):
            assert time.monotonic() < until, (self.errors, self.value("document.body.innerText"))
            time.sleep(0.05)

    def screenshot(self) -> np.ndarray:
        """Return what the window shows. uint8 RGB [H, W, 3]"""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        return image[..., ::-1]


@contextmanager
def browser(folder: Path, tab: type[Browser] = Browser, flags: Sequence[str] = _FLAGS) -> Iterator[Any]:
    """Start a browser with its profile in a folder, give its tab, and end it."""
    program = find_chromium()
    read_there, write_here = os.pipe()
    read_here, write_there = os.pipe()

    def pipes() -> None:
        # the browser reads from 3 and writes to 4: both ends are first lifted over those, so that neither is lost
        lifted = [fcntl.fcntl(each, fcntl.F_DUPFD, 10) for each in (read_there, write_there)]
        for number, end in zip((3, 4), lifted, strict=True):
            os.dup2(end, number)

    process = subprocess.Popen(
        [program, *flags, "--remote-debugging-pipe", f"--user-data-dir={folder}"],
        close_fds=False,
        preexec_fn=pipes,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(read_there)
    os.close(write_there)
    try:
        with os.fdopen(write_here, "wb", buffering=0) as to, os.fdopen(read_here, "rb", buffering=0) as back:
            yield tab(to, back)
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


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
    with profile as folder, browser(Path(folder), Page, CHROMIUM_OPTIONS) as page:
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
