"""`pop learn`: build your own Gaussian splatting in NumPy, judged stage by stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import tyro

from pop_fast.cli.arguments import parse

_EXAMPLES: Final = """
    pop learn start mine           write twelve files to fill in
    pop learn check alpha          judge one of them, in seconds
    pop learn map                  the pipeline, and the picture that it draws as it stands
    pop learn train                when all is written: train with your own code
"""

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]


@dataclass(frozen=True, kw_only=True)
class Start:
    """Write twelve modules, one a stage, in which every function is yours to write; nothing is written over."""

    folder: Folder = Path("mine")
    """Where."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Judge a stage. Exit status 0 when it has passed, 1 when not yet."""

    stage: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STAGE")]
    """A file's name without .py: alpha, covariance, ..."""
    folder: Folder = Path("mine")
    """Your files."""
    answer: bool = False
    """Show the oracle's code: at once if the stage has passed, else when asked for the second time."""


@dataclass(frozen=True, kw_only=True)
class Map:
    """Show the pipeline and write the picture that your stages draw, with the oracle's in place of what is missing."""

    folder: Folder = Path("mine")
    """Your files."""
    out: Path | None = None
    """The picture; DIR/picture.png if not given."""


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train a small scene with your own code, when all of it is written."""

    folder: Folder = Path("mine")
    """Your files."""
    steps: int = 60
    """How many."""
    out: Path | None = None
    """Photograph and render side by side; DIR/trained.png if not given."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Build your own Gaussian splatting in NumPy; what you have not written is borrowed from the oracle."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Start, tyro.conf.subcommand("start")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Map, tyro.conf.subcommand("map")]
        | Annotated[Train, tyro.conf.subcommand("train")]
    ]


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    action = parse(Args, argv, "learn", examples=_EXAMPLES).action
    from pop_ref.learn import __main__ as course

    if isinstance(action, Start):
        return course.write_stubs(action.folder)
    if isinstance(action, Check):
        return course.check(action.stage, action.folder, action.answer)
    if isinstance(action, Map):
        return course.show_map(action.folder, action.out)
    return course.train_work(action.folder, action.steps, action.out)
