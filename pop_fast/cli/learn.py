"""`pop learn`: build your own Gaussian splatting in NumPy, judged stage by stage."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from pop_fast.cli import parse
from pop_fast.io.atomic import write_file

_EXAMPLES: Final = """
    pop learn start mine           write thirteen files to fill in
    pop learn check alpha          judge one of them, in seconds
    pop learn check --all          judge all of them, with a score; --json for a program that reads it
    pop learn map                  the pipeline, and the picture that it draws so far
    pop learn train                at the end: train with your own code
    pop learn train --picture me.jpg
    pop learn class submissions    a table of a class, one folder a student
"""

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]


@dataclass(frozen=True, kw_only=True)
class Start:
    """Write thirteen modules, one a stage, in which every function is yours to write; nothing is written over."""

    folder: Folder = Path("mine")
    """Where."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Judge a stage, or all of them. Exit status 0 when it has passed, 1 when not yet."""

    stage: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="STAGE")] = ""
    """A file's name without .py: alpha, covariance, ...; with --all it is left out."""
    folder: Folder = Path("mine")
    """Your files."""
    answer: bool = False
    """Show the oracle's code: at once if the stage has passed, else at the second request."""
    all: bool = False
    """Judge every stage, and count the functions that are right."""
    json: bool = False
    """With --all: print one object for a program to read."""


@dataclass(frozen=True, kw_only=True)
class Map:
    """Show the pipeline and write the picture that your stages draw, with the oracle's in place of what is missing."""

    folder: Folder = Path("mine")
    """Your files."""
    out: Path | None = None
    """The picture; DIR/picture.png if not given."""


@dataclass(frozen=True, kw_only=True)
class Train:
    """Train at 64 px with your own code, when all of it is written: the toy, or what you give."""

    folder: Folder = Path("mine")
    """Your files."""
    picture: Path | None = None
    """A picture to fit instead of the toy; its middle square is taken."""
    scene: Path | None = None
    """A capture to fit instead of the toy, as `pop train` takes it; one view in eight is held out."""
    steps: int = 120
    """How many; the default takes some minutes in plain NumPy."""
    out: Path | None = None
    """Photograph and render side by side; DIR/trained.png if not given. A film for browsers is written next to it."""


@dataclass(frozen=True, kw_only=True)
class Class:
    """Grade a class, every submission in its own process; a submission is a program and runs with your rights."""

    folder: Folder
    """A folder with one folder for each student, with files of the course."""
    seconds: float = 300.0
    """How long one submission may take."""
    out: Path | None = None
    """The table as markdown; DIR/report.md if not given."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Build your own Gaussian splatting in NumPy; what you have not written is borrowed from the oracle."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Start, tyro.conf.subcommand("start")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Map, tyro.conf.subcommand("map")]
        | Annotated[Train, tyro.conf.subcommand("train")]
        | Annotated[Class, tyro.conf.subcommand("class")]
    ]


def run(argv: Sequence[str]) -> int:
    action = parse(Args, argv, "learn", examples=_EXAMPLES).action
    if isinstance(action, Class):
        return _class(action)
    from pop_ref.learn import __main__ as course

    if isinstance(action, Start):
        return course.write_stubs(action.folder)
    if isinstance(action, Map):
        return course.show_map(action.folder, action.out)
    if isinstance(action, Train):
        return course.train_work(action.folder, _subject(action), action.steps, action.out)
    course.refuse_unread(action.all, action.json, action.answer)
    if action.all:
        # what stands first is the folder, as no stage is named
        return course.check_all(Path(action.stage) if action.stage else action.folder, action.json)
    return course.check(action.stage, action.folder, action.answer)


def _class(args: Class) -> int:
    from pop_ref.learn import needs_of_judging

    needs_of_judging()
    from pop_ref.learn.grading import class_report, submissions

    found, left_out = submissions(args.folder)
    if left_out:
        print(f"not graded, since no file of the course lies right inside: {', '.join(left_out)}", flush=True)
    grades = []
    for folder in found:
        grades.append((folder.name, _graded_apart(folder, args.seconds)))
        print(f"{folder.name}: {grades[-1][1].get('stopped') or grades[-1][1]['score']}", flush=True)
    out = args.out or args.folder / "report.md"
    write_file(out, class_report(grades))
    print(f"the class -> {out}")
    return 0


def _graded_apart(folder: Path, seconds: float) -> dict[str, Any]:
    """Grade a submission in its own process, which may take so long."""
    from pop_fast.children import module_command
    from pop_ref.learn.grading import read_grade, stopped

    command = module_command("pop_ref.learn.grading", str(folder))
    try:
        # who asks for input gets none, and does not wait for whoever grades
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=seconds,
        )
    except subprocess.TimeoutExpired:
        return stopped(f"it runs for longer than {seconds:g} s; is there an endless loop?")
    grade = read_grade(done.stdout)
    if grade is not None:
        return grade
    if done.returncode == 0:
        return stopped("its output cannot be distinguished from a grade")
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return stopped(f"it ended with status {done.returncode}: {last}".rstrip(": "))


def _subject(args: Train):
    """Read what is trained on, made small."""
    from pop_ref.learn.training import SIZE, a_capture, a_picture, shrunk, the_toy

    if args.picture is not None and args.scene is not None:
        raise ValueError("--picture and --scene exclude each other; give one of them, or none for the toy")
    if args.picture is not None:
        from pop_fast.io.images import read_image

        return a_picture(read_image(args.picture) / 255.0)
    if args.scene is None:
        return the_toy()
    from pop_fast.data import load_capture

    capture = load_capture(args.scene)
    views = []
    for view in capture.views[:: max(1, len(capture.views) // 72)]:
        # a photograph that is small already is not enlarged
        width = min(SIZE, view.width)
        by = width / view.width
        height = max(1, round(view.height * by))
        K = view.K.copy()
        K[:2] *= [[by], [height / view.height]]
        views.append(((view.viewmat, K, width, height), shrunk(view.image[..., :3] / 255.0, width, height)))
    return a_capture(views, capture.points, capture.points_rgb / 255.0, capture.scene_scale())
