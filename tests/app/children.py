"""Calls in processes of their own: for input that could end the interpreter, and as torchrun starts them."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.app.conftest import Outcome

ROOT = Path(__file__).parents[2]


def in_a_child(script: str, *words: object, seconds: float = 300.0) -> Outcome:
    """Run a script with these words in `sys.argv[1:]`; a signal that ended it is a negative status."""
    command = [sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False, cwd=ROOT)
    return Outcome(done.returncode, done.stdout, done.stderr)


def pop_in_a_child(*words: object) -> Outcome:
    """Call `pop WORD ...` in a process of its own."""
    return in_a_child("import sys; from pop_fast.cli import main; sys.exit(main(sys.argv[1:]))", *words)


def launched(words: Sequence[object], size: int = 2, seconds: float = 300.0) -> list[Outcome]:
    """Call `python WORD ...` in so many processes at once and return what each came to, by rank."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    together = {"WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": 1}
    started: list[subprocess.Popen[str]] = []
    try:
        for rank in range(size):
            told = {name: str(value) for name, value in {**together, "RANK": rank, "LOCAL_RANK": rank}.items()}
            command = [sys.executable, *map(str, words)]
            pipe, environment = subprocess.PIPE, {**os.environ, **told}
            child = subprocess.Popen(command, stdout=pipe, stderr=pipe, env=environment, cwd=ROOT, text=True)
            started.append(child)
        ended = [(child.communicate(timeout=seconds), child.returncode) for child in started]
    finally:
        for child in started:
            child.kill()
    return [Outcome(status, out, err) for (out, err), status in ended]
