"""Processes that find each other as torchrun lets them: by their number, how many they are, and where to meet."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Sequence

from tests.app.children import ROOT
from tests.app.conftest import Outcome


def launched(words: Sequence[object], size: int = 2, seconds: float = 300.0) -> list[Outcome]:
    """Call `python WORD ...` in so many processes at once and return what each came to, by rank."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    together = {"WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": 1}
    started: list[subprocess.Popen[str]] = []
    try:
        for rank in range(size):
            told = {name: str(value) for name, value in {**together, "RANK": rank}.items()}
            command = [sys.executable, *map(str, words)]
            pipe, environment = subprocess.PIPE, {**os.environ, **told}
            child = subprocess.Popen(command, stdout=pipe, stderr=pipe, env=environment, cwd=ROOT, text=True)
            started.append(child)
        ended = [(child.communicate(timeout=seconds), child.returncode) for child in started]
    finally:
        for child in started:
            child.kill()
    return [Outcome(status, out, err) for (out, err), status in ended]
