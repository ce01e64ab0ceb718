"""A headless Chromium that shows a page and hands back pictures of it, over the DevTools protocol on two pipes."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import pytest

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
        """Show an address in a window of this size, px."""
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)
        self.call("Page.navigate", url="about:blank")
        self.call("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        """Evaluate an expression in the page."""
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Wait until an expression is true in the page."""
        until = time.monotonic() + _PATIENCE
        while not self.value(expression):
            assert time.monotonic() < until, (self.errors, self.value("document.body.innerText"))
            time.sleep(0.05)

    def screenshot(self) -> np.ndarray:
        """Return what the window shows. uint8 RGB [H, W, 3]"""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
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
