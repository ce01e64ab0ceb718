"""A disk that fails: runs that end before, or are refused, any change of it, and checkpoints with a flipped bit."""

from __future__ import annotations

import builtins
import errno
import io
import os
import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from pop_fast.cli import EXIT_INCOMPLETE
from pop_fast.errors import PopError
from pop_fast.io.formats import load_splat_file
from pop_fast.io.ply import save_ply
from pop_fast.train import checkpoint as ckpt

from .corpus import HERE
from .runs import KINDS, STEPS, TOLD, UndisturbedRun, ended, run_parts, same, start, wait

# what changes a disk besides writes; a process may end, and the system may refuse, right before each of them
_CHANGES = (
    *((os, name) for name in ("replace", "fsync")),
    *((Path, name) for name in ("touch", "mkdir", "unlink", "rmdir")),
    (shutil, "rmtree"),
)
# exit statuses of a child: where it was made to end, and where it came to no such change
CRASHED, UNREACHED = 77, 78
_ERRORS = (errno.ENOSPC, errno.EACCES, errno.EIO, errno.EROFS)


def crash_points(of: UndisturbedRun, most: int | None) -> dict[str, Any]:
    """End the process right before every change of the disk and in the middle of writes, and look at what is left.

    Args:
        of: what is trained.
        most: so many points of each job at most, spread evenly; None takes all.
    """
    return _at_points(of, most, lambda number: os._exit(CRASHED))


def failing_writes(of: UndisturbedRun, most: int | None) -> dict[str, Any]:
    """Let every change of the disk, and every write of a file in its middle, be refused by the system in turn."""

    def refuse(number: int) -> None:
        code = _ERRORS[number % len(_ERRORS)]
        raise OSError(code, os.strerror(code))

    return _at_points(of, most, refuse)


def _at_points(of: UndisturbedRun, most: int | None, fault: Callable[[int], None]) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for job, (work, check) in _jobs(of).items():
        points = _count(of, job, work)
        step = 1 if most is None else max(points / most, 1.0)
        chosen = sorted({int(step * k) for k in range(points) if step * k < points})
        failures, statuses = list[str](), Counter[str]()
        for number in chosen:
            _prepare(of, job)
            said = of.folder / "said"
            said.unlink(missing_ok=True)

            def disturbed(number: int = number, work: Callable[[], int] = work) -> int:
                run_parts(in_children=False)
                with disturbing(number, partial(fault, number)) as reached:
                    status = work()
                return status if reached[0] > number else UNREACHED

            status = ended(*of.together([disturbed, *[work] * (of.kind.ranks - 1)], said))
            text = said.read_text() if said.exists() else ""
            # a result that is complete but for its report is told of with another status
            came = {CRASHED: "ended", 0: "continued", TOLD: "told", EXIT_INCOMPLETE: "told"}.get(status, "else")
            statuses[came] += 1
            wrong = None if came != "else" and "Traceback" not in text else f"status {status}: {text[-300:]}"
            wrong = wrong or check()
            failures += [f"{job}, point {number}: {wrong}"] if wrong else []
        results[job] = {"points": points, "tried": len(chosen), **statuses, "failures": failures}
    return results


def _jobs(of: UndisturbedRun) -> dict[str, tuple[Callable[[], int], Callable[[], str | None]]]:
    """List what writes, each with what must hold after it was disturbed."""
    train = (lambda: of.train("run", "--resume"), lambda: of.finish("run"))
    if of.kind is not KINDS["native step"]:
        return {"train": train}
    # whoever looks next finds the old result or the new one, and can train over it
    overwrite = (lambda: of.train("over", "--overwrite"), lambda: of.finish("over", "--overwrite"))
    return {"train": train, "train --overwrite": overwrite, "write a PLY": _writing(of)}


def _writing(of: UndisturbedRun) -> tuple[Callable[[], int], Callable[[], str | None]]:
    splat, old = of.folder / "splat.ply", of.folder / "old.ply"

    def rewrite() -> int:
        save_ply(splat, {key: value + 0.25 for key, value in load_splat_file(old)[0].items()})
        return 0

    def old_or_new() -> str | None:
        try:
            means = load_splat_file(splat)[0]["means"]
        except PopError as error:
            return str(error)
        moved = float((means - load_splat_file(old)[0]["means"]).abs().max())
        return None if moved in (0.0, 0.25) or abs(moved - 0.25) < 1e-6 else "a splat is neither the old nor the new"

    return rewrite, old_or_new


def _prepare(of: UndisturbedRun, job: str) -> None:
    for name in ("run", "over"):
        shutil.rmtree(of.folder / name, ignore_errors=True)
    if job == "train --overwrite":
        shutil.copytree(of.folder / "whole", of.folder / "over")
    if job == "write a PLY":
        for name in ("splat.ply", "old.ply"):
            shutil.copy(HERE / "splats" / "splat.ply", of.folder / name)


def _count(of: UndisturbedRun, job: str, work: Callable[[], int]) -> int:
    """Count the changes of the disk of a job that nobody disturbs."""
    told = of.folder / "count"

    def counted() -> int:
        run_parts(in_children=False)
        with disturbing(-1, lambda: None) as reached:
            status = work()
        told.write_text(str(reached[0]))
        return status

    _prepare(of, job)
    status = ended(*of.together([counted, *[work] * (of.kind.ranks - 1)], of.folder / "said"))
    if status != 0:
        raise RuntimeError(f"{job} ended with {status}: {(of.folder / 'said').read_text()[-2000:]}")
    return int(told.read_text())


@contextmanager
def disturbing(at: int, fault: Callable[[], None]) -> Iterator[list[int]]:
    """Let something happen right before the change of the disk with this number, and count them all."""
    reached = [0]

    def meet() -> None:
        reached[0] += 1
        if reached[0] - 1 == at:
            fault()

    def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*words: Any, **named: Any) -> Any:
            meet()
            return function(*words, **named)

        return call

    def opening(file: Any, mode: str = "r", *words: Any, **named: Any) -> Any:
        if mode in ("wb", "r+b") and isinstance(file, Path):
            raw = _Meeting(file, mode, meet)
            return raw if named.get("buffering") == 0 else io.BufferedWriter(raw, 512)
        return plain(file, mode, *words, **named)

    plain, before = builtins.open, [(owner, name, getattr(owner, name)) for owner, name in _CHANGES]
    try:
        for owner, name, function in before:
            setattr(owner, name, wrapped(function))
        builtins.open = opening  # type: ignore[assignment]
        yield reached
    finally:
        builtins.open = plain
        for owner, name, function in before:
            setattr(owner, name, function)


class _Meeting(io.FileIO):
    """A file of which half a write gets to the disk before something happens, at the first and the third."""

    def __init__(self, path: Path, mode: str, meet: Callable[[], None]) -> None:
        super().__init__(path, mode)
        self._meet, self._writes = meet, 0

    def write(self, data: Any) -> int:  # type: ignore[override]
        self._writes += 1
        if self._writes in (1, 3):
            super().write(memoryview(data)[: len(data) // 2])
            self._meet()
            self.seek(-(len(data) // 2), os.SEEK_CUR)
        return super().write(data) or 0


def bit_flips(of: UndisturbedRun, flips: int, seed: int) -> dict[str, Any]:
    """Flip single bits of a checkpoint: it is refused, or read as what it was."""
    path = ckpt.checkpoint_path(of.folder / "whole", STEPS - 1)
    data, whole, rng = path.read_bytes(), ckpt.load_checkpoint(path), random.Random(seed)
    told = of.folder / "flips"

    def read_all() -> None:
        found = Counter[str]()
        target = of.folder / "rotten" / "ckpts" / path.name
        target.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(flips):
            changed = bytearray(data)
            changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
            target.write_bytes(changed)
            with suppress(PopError):
                found["the same" if same(ckpt.load_checkpoint(target), whole) else "another"] += 1
        told.write_text(f"{found['the same']} {found['another']}")

    status = wait(start(read_all, of.folder / "said"))
    if status != 0:
        return {"flips": flips, "failures": [f"ended with {status}: {(of.folder / 'said').read_text()[-300:]}"]}
    equal, other = map(int, told.read_text().split())
    failures = [f"{other} of {flips} were read as another content (seed {seed})"] if other else []
    return {"flips": flips, "refused": flips - equal - other, "the same": equal, "failures": failures}
