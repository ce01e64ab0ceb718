"""The commands of child Pythons, all of which are made here.

Python puts the current folder before its own library for `-m` and `-c`. A folder of photographs that somebody sent
could so replace any module of the program; `-P` leaves the folder out.
"""

from __future__ import annotations

import runpy
import site
import sys
from pathlib import Path
from typing import Final

# Snakemake and CMake start Pythons of their own: these take it from the environment
SAFE_PATH: Final = {"PYTHONSAFEPATH": "1"}


def python_command(*words: str) -> list[str]:
    """Return the command of a child Python, given its words, that finds no module in the current folder."""
    return [sys.executable, "-P", *words]


def module_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module, as `python -m` does, of the packages that this process runs."""
    return python_command(str(Path(__file__).resolve()), module, *words)


def main() -> None:
    """Run the module that the first word names, with the other words as its arguments."""
    root, others = str(Path(__file__).resolve().parents[1]), {*site.getsitepackages(), site.getusersitepackages()}
    if root not in sys.path:
        # a copy that was never installed: after Python's own library, before another version that was
        sys.path.insert(next((k for k, place in enumerate(sys.path) if place in others), len(sys.path)), root)
    # `alter_sys` gives the module its own name in `sys.argv`
    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
