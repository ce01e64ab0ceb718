"""Find a Chromium, which prints the walk-through as PDF and takes its pictures in tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Final

_NAMES: Final = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
)

# inside a container Chromium may neither make its sandbox nor rely on /dev/shm
OPTIONS: Final = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-extensions",
    "--disable-background-networking",
    "--force-color-profile=srgb",
)


class BrowserError(Exception):
    """There is no Chromium, or it wrote nothing; the message says what to do."""


def chromium() -> str | None:
    """Find the browser's program: the environment's `CHROMIUM`, or one of its usual names on the path."""
    wanted = os.environ.get("CHROMIUM")
    if wanted:
        return shutil.which(wanted)
    return next((found for name in _NAMES if (found := shutil.which(name))), None)


def print_pdf(page: Path, pdf: Path) -> None:
    """Print a page.

    Args:
        page: an HTML file.
        pdf: what to write; a file that is there is replaced once the new one is whole.

    Raises:
        BrowserError: there is no Chromium, or it printed nothing.
    """
    program = chromium()
    if program is None:
        raise BrowserError(
            "a PDF needs Chromium or Chrome: install it (apt install chromium) or set CHROMIUM to its path"
        )
    with tempfile.TemporaryDirectory() as folder:
        printed = Path(folder) / "printed.pdf"
        to = (
            f"--user-data-dir={folder}/profile",
            "--no-pdf-header-footer",
            f"--print-to-pdf={printed}",
        )
        done = subprocess.run(
            [program, *OPTIONS, *to, page.resolve().as_uri()],
            capture_output=True,
            text=True,
        )
        if not printed.exists():
            raise BrowserError(
                f"{program} printed nothing (exit status {done.returncode}): {done.stderr.strip()[-400:]}"
            )
        partial = pdf.with_name(f".{pdf.name}.partial")
        shutil.copyfile(printed, partial)
        os.replace(partial, pdf)
