"""How the subcommands read their words: tyro over a dataclass, `_` and `-` alike, examples under the help."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Final, TypeVar

import tyro

T = TypeVar("T")

# a switch is shown with its opposite, so that one sentence is right for both
_STYLE: Final = (tyro.conf.HelptextFromCommentsOff,)


def parse(kind: type[T], argv: Sequence[str], command: str, default: T | None = None, examples: str = "") -> T:
    """Read the words after `pop COMMAND` into a dataclass.

    Args:
        kind: the dataclass; its docstring is the description.
        argv: the words.
        command: the subcommand's name, for usage lines.
        default: values that words override, for dataclasses without defaults of their own.
        examples: shown under the description, one a line.

    Raises:
        SystemExit: 0 after --help, 2 after bad usage (tyro has then said what is wrong).
    """
    about = inspect.cleandoc(kind.__doc__ or "").partition("\nAttributes:")[0].strip()
    if examples:
        about += "\n\nexamples:\n" + "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines())
    start = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(kind, args=list(argv), prog=f"pop {command}", description=about, default=start, config=_STYLE)
