"""A headless Chromium on a pipe: open a page at a size, ask it things, press and drag, and take its picture."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Self

from pop_ref.walkthrough.builder.command import CHROMIUM_OPTIONS as OPTIONS
from pop_ref.walkthrough.builder.command import chromium

# where pictures are kept to be looked at
SCREENSHOTS = os.environ.get("POP_SCREENSHOTS")

WHY_NOT = "" if chromium() else "there is no Chromium here (apt install chromium)"


def keep(png: bytes, name: str) -> None:
    """Write a picture into the folder that the environment's `POP_SCREENSHOTS` names, if it names one."""
    if SCREENSHOTS:
        Path(SCREENSHOTS).mkdir(parents=True, exist_ok=True)
        (Path(SCREENSHOTS) / name).write_bytes(png)


class Page:
    """One tab. Everything that the page logs or throws is kept in `complaints`."""

    def __init__(self) -> None:
        self.complaints: list[str] = []
        self._profile = tempfile.mkdtemp(prefix="chromium-")
        to_browser, self._to = os.pipe()
        self._from, from_browser = os.pipe()
        # the protocol is spoken on descriptors 3 and 4: first lift both ends over those, so that neither is lost
        lifted = [fcntl.fcntl(each, fcntl.F_DUPFD, 10) for each in (to_browser, from_browser)]

        def wire() -> None:
            os.dup2(lifted[0], 3)
            os.dup2(lifted[1], 4)

        self._process = subprocess.Popen(
            [chromium() or "", *OPTIONS, "--remote-debugging-pipe", f"--user-data-dir={self._profile}", "about:blank"],
            preexec_fn=wire,
            pass_fds=(3, 4),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for each in (to_browser, from_browser, *lifted):
            os.close(each)
        self._rest, self._number, self._session = b"", 0, ""
        try:
            self._attach()
        except BaseException:
            self.__exit__()
            raise

    def _attach(self) -> None:
        page = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")
        self.call("Page.setLifecycleEventsEnabled", enabled=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)
        shutil.rmtree(self._profile, ignore_errors=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the DevTools protocol and wait for its answer."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            told = self._next()
            if told.get("id") == self._number:
                if "error" in told:
                    raise RuntimeError(f"{method}: {told['error']}")
                return told["result"]

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
        while (told := self._next()).get("method") != "Page.lifecycleEvent" or (
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
        codes = {
            "ArrowLeft": 37,
            "ArrowUp": 38,
            "ArrowRight": 39,
            "ArrowDown": 40,
            "Home": 36,
            "End": 35,
            "Enter": 13,
            " ": 32,
        }
        for kind in ("keyDown", "keyUp"):
            text = {"text": "\r"} if key == "Enter" and kind == "keyDown" else {}
            text = {"text": key} if len(key) == 1 and kind == "keyDown" else text
            code = codes.get(key, ord(key[0].upper()))
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

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            more = os.read(self._from, 1 << 20)
            if not more:
                raise RuntimeError("Chromium has gone away")
            self._rest += more
        line, self._rest = self._rest.split(b"\0", 1)
        told = json.loads(line)
        if told.get("method") == "Runtime.exceptionThrown":
            details = told["params"]["exceptionDetails"]
            self.complaints.append(details.get("exception", {}).get("description", details["text"]))
        if told.get("method") == "Runtime.consoleAPICalled" and told["params"]["type"] in ("error", "warning"):
            self.complaints.append(str([each.get("value") for each in told["params"]["args"]]))
        if told.get("method") == "Log.entryAdded":
            self.complaints.append(told["params"]["entry"]["text"])
        return told
