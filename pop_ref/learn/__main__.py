"""The course's command: `python -m pop_ref.learn`, `pop-learn`, and `pop learn` of the program."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Timer
from typing import Final

import numpy as np

from pop_ref.learn import needs_of_judging
from pop_ref.learn.course import BY_NAME, COURSE, Stage, stage_named
from pop_ref.learn.progress import asked_before, course_map, note_passed, passed_stages, picture
from pop_ref.learn.splat import write_png
from pop_ref.learn.stubs import answer, start
from pop_ref.learn.student import Work, read_work
from pop_ref.learn.training import Subject, the_toy, train


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one action of the command line.

    Args:
        arguments: default the process's own.

    Returns:
        The exit status: 0; 1 for a stage that has not passed yet; 2, with one line on stderr, for what cannot be done,
        and so 130 after Ctrl-C.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["check"]:
        # its options have no values, and argparse reads a stage and a folder only where they stand together
        words[1:] = sorted(words[1:], key=lambda word: not word.startswith("-"))
    given = _parser().parse_args(words)
    if given.action == "check" and given.all:
        # the only name is the folder's
        given.folder = Path(given.stage or given.folder)
    actions = {
        "start": lambda: write_stubs(given.folder),
        "check": lambda: (
            check_all(given.folder, given.json) if given.all else check(given.stage, given.folder, given.answer)
        ),
        "map": lambda: show_map(given.folder, given.out),
        "train": lambda: train_work(given.folder, the_toy(), given.steps, given.out),
    }
    try:
        if given.action == "check":
            refuse_unread(given.all, given.json, given.answer)
        return actions[given.action]()
    except (ValueError, OSError) as error:
        print(f"pop-learn: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pop-learn: interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pop-learn", description="Build your own Gaussian splatting in NumPy.")
    actions = parser.add_subparsers(dest="action", required=True)
    starting = actions.add_parser("start", help="write thirteen files to fill in; nothing is written over")
    checking = actions.add_parser("check", help="judge one of them, in seconds")
    mapping = actions.add_parser("map", help="the pipeline, and the picture that it draws so far")
    training = actions.add_parser("train", help="at the end: train with your own code")
    checking.add_argument("stage", nargs="?", default="", help="a file's name without .py: alpha, ...; not with --all")
    checking.add_argument(
        "--all", action="store_true", help="judge every stage, and count the functions that are right"
    )
    checking.add_argument("--json", action="store_true", help="with --all: print one object for a program to read")
    checking.add_argument("--answer", action="store_true", help="show the oracle's code, asked for twice or passed")
    training.add_argument("--steps", type=int, default=120, help="default 120")
    for action in (starting, checking, mapping, training):
        action.add_argument("folder", type=Path, nargs="?", default=Path("mine"), help="your files, default mine")
    for action in (mapping, training):
        action.add_argument("--out", type=Path, help="the picture; a file in the folder if not given")
    return parser


def refuse_unread(every: bool, as_json: bool, wants_answer: bool) -> None:
    """Raise ValueError for an option of `check` that nothing would read."""
    if as_json and not every:
        raise ValueError("--json belongs to --all: check --all --json")
    if wants_answer and every:
        raise ValueError("--answer is of one stage: check STAGE --answer, without --all")


def write_stubs(folder: Path) -> int:
    """Write the modules that are not there yet, and return the exit status 0."""
    written = start(folder)
    print(f"{len(written)} new files -> {folder}" if written else f"{folder} has all files already")
    print(
        f"next: open {folder / 'alpha.py'}, which chapter 1 explains, write a function, and 'pop-learn check alpha"
        f" {folder}'; any order will do, the stages' numbers are those of the pipeline"
    )
    return 0


# after which a learner is told what takes so long
_LONG_S: Final = 8.0


@contextmanager
def telling(what: str) -> Iterator[None]:
    """Say on stderr what is being judged, if the block takes long: a loop that never ends looks like a slow machine."""

    def tell() -> None:
        text = f"judging {what} takes more than {_LONG_S:g} seconds; if that is a loop without an end, Ctrl-C stops it"
        print(f"pop-learn: {text}", file=sys.stderr, flush=True)

    timer = Timer(_LONG_S, tell)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def check(name: str, folder: Path, wants_answer: bool) -> int:
    """Judge a stage, draw its counterexample, and return 0 when it has passed, 1 when not yet.

    Raises:
        ValueError: the stage is unknown, a file cannot be read, or Hypothesis is missing.
    """
    stage, work = stage_named(name), read_work(folder)
    needs_of_judging()
    from pop_ref.learn.drawing import drawn_counterexample
    from pop_ref.learn.judge import judge, told

    verdict = judge(work, stage, telling)
    print(told(stage, verdict))
    counterexample = _counterexample(folder, stage)
    image = drawn_counterexample(verdict)
    if image is None:
        # an earlier one is not of this file
        counterexample.unlink(missing_ok=True)
    else:
        write_png(counterexample, image)
        print(f"the counterexample, yours in orange and what it should be in blue -> {counterexample}")
    if verdict.passed:
        note_passed(folder, stage)
        _tell_of_the_pages(folder)
    if wants_answer and (verdict.passed or asked_before(folder, stage)):
        print(f"\nthe oracle's {stage.name}:\n\n{answer(stage)}")
    elif wants_answer:
        print("\nThe answer is shown when you ask again. Try the hint first.")
    return 0 if verdict.passed else 1


def _counterexample(folder: Path, stage: Stage) -> Path:
    return folder / f"counterexample_{stage.name}.png"


def check_all(folder: Path, as_json: bool) -> int:
    """Judge every stage, print the score, and return 0 when all have passed, 1 when not yet.

    Raises:
        ValueError: a file cannot be read, or Hypothesis is missing.
    """
    needs_of_judging()
    from pop_ref.learn.grading import graded, told_in_lines

    grade = graded(read_work(folder), telling)
    for name in grade["passed"]:
        note_passed(folder, BY_NAME[name])
        # of an earlier try
        _counterexample(folder, BY_NAME[name]).unlink(missing_ok=True)
    print(json.dumps(grade) if as_json else told_in_lines(grade))
    if grade["passed"] and not as_json:
        _tell_of_the_pages(folder)
    return 0 if len(grade["passed"]) == len(COURSE) else 1


def _tell_of_the_pages(folder: Path) -> None:
    end = f".html#passed={','.join(passed_stages(read_work(folder)))}"
    print(f"the pages show the oracle's functions of these stages when an address ends in {end}")


def show_map(folder: Path, out: Path | None) -> int:
    """Print the pipeline, write the picture that the stages draw as they stand, and return the exit status 0."""
    work = read_work(folder)
    print(course_map(work, color=sys.stdout.isatty()))
    image, complaints = picture(work)
    for line in complaints:
        print(line)
    out = out or folder / "picture.png"
    oracles = picture(Work(work.folder, dict.fromkeys(work.written, ())))[0]
    _write(out, np.concatenate([image, oracles], axis=1))
    difference = float(np.max(np.abs(image - oracles)))
    agree = "they are the same" if difference < 1e-9 else f"they differ by up to {difference:.3g}"
    print(f"the picture as it stands, and the oracle's on its right -> {out}; {agree}")
    return 0


def train_work(folder: Path, subject: Subject, steps: int, out: Path | None) -> int:
    """Train on a subject with the student's code, write picture and film, and return the exit status 0."""
    from pop_ref.learn.drawing import write_film

    out, frames = out or folder / "trained.png", []
    for told in train(read_work(folder), subject, steps):
        # before the first step there is none
        loss = f"{told.loss:.5f}" if np.isfinite(told.loss) else "-".ljust(7)
        print(f"step {told.step:3d}   loss {loss}   {told.psnr:.2f} dB   {told.n} Gaussians", flush=True)
        frames.append(told.picture.repeat(4, axis=0).repeat(4, axis=1))
        _write(out, told.picture)
        if len(told.psnrs) > 1:
            low, mean, high = min(told.psnrs), sum(told.psnrs) / len(told.psnrs), max(told.psnrs)
            print(f"{len(told.psnrs)} views that no step saw: {mean:.2f} dB on average, {low:.2f} to {high:.2f}")
    film = out.with_name(f"{out.stem}_film.png")
    write_film(film, frames)
    print(f"photograph and render -> {out}; the film, for a browser -> {film}")
    return 0


def _write(path: Path, image: np.ndarray) -> None:
    write_png(path, image.repeat(8, axis=0).repeat(8, axis=1))


if __name__ == "__main__":
    sys.exit(main())
