"""What the installed programs call: Ctrl-C while a program is still being loaded shows no traceback either."""

from __future__ import annotations

import importlib
import sys


def pop() -> int:
    """Run `pop`; see `pop_fast.cli.main`."""
    return _begin("pop", "pop_fast.cli")


def pop_repro() -> int:
    """Run `pop-repro`; see `paper_repro.cli.main`."""
    return _begin("pop-repro", "paper_repro.cli")


def _begin(program: str, module: str) -> int:
    try:
        main = importlib.import_module(module).main
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    return main()
