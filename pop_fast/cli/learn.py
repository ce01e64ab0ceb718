"""`pop learn`: build your own Gaussian splatting in NumPy, judged stage by stage."""

from __future__ import annotations

import sys
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
    if isinstance(action, Start):
        return _start(action)
    if isinstance(action, Check):
        return _check(action)
    return _map(action) if isinstance(action, Map) else _train(action)


def _start(args: Start) -> int:
    from pop_ref.learn.stubs import start

    written = start(args.folder)
    print(f"{len(written)} new files -> {args.folder}" if written else f"{args.folder} has all files already")
    print(f"next: open {args.folder / 'alpha.py'}, write a function, and 'pop learn check alpha {args.folder}'")
    return 0


def _check(args: Check) -> int:
    from pop_ref.learn import needs_of_judging
    from pop_ref.learn.course import stage_named
    from pop_ref.learn.progress import asked_before, note_passed
    from pop_ref.learn.stubs import answer
    from pop_ref.learn.student import read_work

    stage, work = stage_named(args.stage), read_work(args.folder)
    needs_of_judging()
    from pop_ref.learn.drawing import drawn_counterexample
    from pop_ref.learn.judge import judge
    from pop_ref.learn.splat import write_png
    from pop_ref.learn.telling import told

    verdict = judge(work, stage)
    print(told(stage, verdict))
    picture = args.folder / f"counterexample_{stage.name}.png"
    image = drawn_counterexample(verdict)
    if image is None:
        # an earlier one is not of this file
        picture.unlink(missing_ok=True)
    else:
        write_png(picture, image)
        print(f"the counterexample, yours in orange and what it should be in blue -> {picture}")
    if verdict.passed:
        note_passed(args.folder, stage)
    if args.answer and (verdict.passed or asked_before(args.folder, stage)):
        print(f"\nthe oracle's {stage.name}:\n\n{answer(stage)}")
    elif args.answer:
        print("\nThe answer is shown when you ask again. Try the hint first.")
    return 0 if verdict.passed else 1


def _map(args: Map) -> int:
    from pop_ref.learn.progress import course_map, picture
    from pop_ref.learn.student import read_work

    work = read_work(args.folder)
    print(course_map(work, color=sys.stdout.isatty()))
    image, complaints = picture(work)
    for line in complaints:
        print(line)
    out = args.out or args.folder / "picture.png"
    _write(out, image)
    print(f"the picture as it stands -> {out}")
    return 0


def _train(args: Train) -> int:
    from pop_ref.learn.student import read_work
    from pop_ref.learn.training import train

    out = args.out or args.folder / "trained.png"
    for told in train(read_work(args.folder), args.steps):
        print(f"step {told.step:3d}   loss {told.loss:.5f}   {told.psnr:.2f} dB   {told.n} Gaussians", flush=True)
        _write(out, told.picture)
    print(f"photograph and render -> {out}")
    return 0


def _write(path: Path, image) -> None:
    from pop_ref.learn.splat import write_png

    write_png(path, image.repeat(8, axis=0).repeat(8, axis=1))
