"""Calls in a process of their own, for input that could end the interpreter."""

from __future__ import annotations

import subprocess
import sys
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
