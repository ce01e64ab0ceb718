"""Commands with a time limit and a file that is written whole: what the stages of `gpu_check` are made of."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
TAIL = 4000  # characters of a command's words that are kept
GRACE = 20.0  # seconds between asking a command to stop and making it


def run(command: list[str], limit: float, **environment: str) -> dict[str, Any]:
    """Run a command in the repository and return its status, seconds and the end of its words.

    A command whose time is up is asked to stop first, so that it can leave a checkpoint; its status is its own answer,
    or 124.
    """
    start = time.monotonic()
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, **environment},
        start_new_session=True,
    )
    try:
        words, _ = process.communicate(timeout=max(limit - GRACE, 1.0))
        status = process.returncode
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        try:
            words, _ = process.communicate(timeout=GRACE)
        except subprocess.TimeoutExpired:
            # compilers and tests have children of their own
            os.killpg(process.pid, signal.SIGKILL)
            words, _ = process.communicate()
        status = process.returncode if process.returncode > 0 else 124
    return {"status": status, "seconds": round(time.monotonic() - start, 1), "output": words[-TAIL:]}


def python_path(*folders: Path) -> str:
    """Return PYTHONPATH with folders put before what it holds."""
    return os.pathsep.join(filter(None, [*map(str, folders), os.environ.get("PYTHONPATH", "")]))


def first_line(command: list[str]) -> str:
    """Return what a command says, or "not found" where there is no such command."""
    if shutil.which(command[0]) is None:
        return "not found"
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=False)
    return (done.stdout or done.stderr).strip()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file whole: a call that is killed leaves what the call before had found."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(json.dumps(content, indent=1) + "\n")
    partial.replace(path)
