"""The commands of child Pythons, all of which are made here.

Python puts the current folder before its own library for `-m` and `-c`. A folder of photographs that somebody sent
could so replace any module of the program; `-P` leaves the folder out.
"""

from __future__ import annotations

import os
import runpy
import signal
import site
import sys
import threading
import time
from pathlib import Path
from typing import Final

# Snakemake and CMake start Pythons of their own: these take it from the environment
SAFE_PATH: Final = {"PYTHONSAFEPATH": "1"}
_STARTER: Final = "POP_STARTED_BY"


def python_command(*words: str) -> list[str]:
    """Return the command of a child Python, given its words, that finds no module in the current folder."""
    return [sys.executable, "-P", *words]


def module_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module, as `python -m` does, of the packages that this process runs."""
    return python_command(str(Path(__file__).resolve()), module, *words)


def ends_with_this() -> dict[str, str]:
    """Return what the environment of a `module_command` says so that it stops in order once this process is gone.

    A process that SIGKILL ends can tell nobody. The child has to have a session of its own.
    """
    return {_STARTER: str(os.getpid())}


def _end_after(starter: int) -> None:
    # Windows gives the number of a parent also when that is gone
    while os.getppid() == starter:
        time.sleep(0.5)
    os.killpg(0, signal.SIGTERM)


def main() -> None:
    """Run the module that the first word names, with the other words as its arguments."""
    root, others = str(Path(__file__).resolve().parents[1]), {*site.getsitepackages(), site.getusersitepackages()}
    if root not in sys.path:
        # a copy that was never installed: after Python's own library, before another version that was
        sys.path.insert(next((k for k, place in enumerate(sys.path) if place in others), len(sys.path)), root)
    starter = os.environ.pop(_STARTER, None)
    if starter is not None and os.name == "posix":
        threading.Thread(target=_end_after, args=(int(starter),), name="starter", daemon=True).start()
    # `alter_sys` gives the module its own name in `sys.argv`
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
