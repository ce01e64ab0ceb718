"""What drives a Chromium through pipes closes them, also when the browser never answers."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.app import browser as of_the_app
from tests.walkthrough import chromium

# ends at once
SILENT = shutil.which("true")


@pytest.mark.parametrize("driver", ["app", "walkthrough"])
def test_a_browser_that_does_not_answer_leaves_no_pipe_open(
    driver: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of_the_app, "find_chromium", lambda: SILENT)
    monkeypatch.setattr(chromium, "chromium", lambda: SILENT)
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises((AssertionError, RuntimeError, BrokenPipeError), match=r"ended|gone away|Broken pipe"):
        (of_the_app.browser(tmp_path) if driver == "app" else chromium.Page()).__enter__()
    assert set(os.listdir("/proc/self/fd")) == before
