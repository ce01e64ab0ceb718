"""A run that is killed, whose disk fails or whose checkpoints rot: it continues to the same bits."""

from __future__ import annotations

import builtins
import errno
import io
import os
import random
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pop_fast.data.capture import Capture
from pop_fast.data.load import load_capture
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.io.formats import load_splat_file
from pop_fast.io.ply import save_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train import checkpoint as ckpt

from .corpus import HERE
from .forks import TOLD, start, wait

STEPS, EVERY = 16, 4
# what changes a disk; a process may end, and the system may refuse, right before each of them
_CHANGES = ((os, "replace"), (os, "fsync"), (Path, "mkdir"), (Path, "unlink"), (Path, "rmdir"), (shutil, "rmtree"))
CRASHED = 77
_ERRORS = (errno.ENOSPC, errno.EACCES, errno.EIO, errno.EROFS)


@dataclass(frozen=True)
class Scene:
    """What is trained, and what a run of it that nobody disturbs ends with."""

    capture: Capture
    folder: Path
    whole: dict[str, Any]

    def config(self, name: str) -> TrainConfig:
        """Return the settings of a run in a folder of this name."""
        plan = POPStrategy(refine_start_iter=2, refine_stop_iter=14, refine_every=4, grow_grad2d=1e-5, pop_stop_iter=14)
        return TrainConfig(
            result_dir=str(self.folder / name),
            max_steps=STEPS,
            checkpoint_every=EVERY,
            eval_steps=(8,),
            save_steps=(8,),
            strategy=plan,
            backend="fast",
            threads=1,
            test_every=3,
            ssim_padding="same",
            progress=False,
        )

    def train(self, name: str, resume: bool = True, overwrite: bool = False) -> None:
        """Train, from the last checkpoint where there is one."""
        TrainingRun(self.config(name), self.capture, resume=resume, overwrite=overwrite).run()

    def finish(self, name: str) -> str | None:
        """Continue a run until its end, in a child; say what is wrong with what it ends with, or None."""
        said = self.folder / "said"
        said.unlink(missing_ok=True)
        status = wait(start(lambda: self.train(name), said))
        if status != 0:
            return f"continuing ended with {status}: {said.read_text()[-300:]}"
        if not same(ended_with(self.folder / name), self.whole):
            return "the bits differ"
        left = [
            path.name for path in (self.folder / name).rglob("*") if "partial" in path.name or "replaced" in path.name
        ]
        return f"{left} is left" if left else None


@contextmanager
def scene() -> Iterator[Scene]:
    """Train once, undisturbed."""
    with tempfile.TemporaryDirectory() as folder:
        made = Scene(load_capture(str(HERE / "colmap")), Path(folder), {})
        made.train("whole")
        made.whole.update(ended_with(Path(folder) / "whole"))
        yield made


def ended_with(folder: Path) -> dict[str, Any]:
    """Return what a finished run's last checkpoint holds, but for the clock."""
    content = ckpt.load_checkpoint(ckpt.checkpoint_path(folder, STEPS - 1))
    return {key: value for key, value in content.items() if key not in ("seconds", "metrics_bytes")}


def same(a: Any, b: Any) -> bool:
    """Compare nested values bit by bit."""
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    return type(a) is type(b) and a == b


def kill_loop(of: Scene, kills: int, minutes: float, seed: int) -> dict[str, Any]:
    """Kill runs at random moments until each of them has ended by itself.

    Args:
        of: what is trained.
        kills: at least.
        minutes: at least.
        seed: decides when.
    """
    rng, end = random.Random(seed), time.monotonic() + 60.0 * minutes
    begun = time.monotonic()
    of.train("timed")
    longest, found, failures = time.monotonic() - begun, Counter[str](), list[str]()
    while found["kills"] < kills or time.monotonic() < end:
        name = f"killed_{found['runs']}"
        found["runs"] += 1
        while True:
            pid = start(lambda name=name: of.train(name), of.folder / "said")
            time.sleep(rng.uniform(0.0, longest))
            os.kill(pid, signal.SIGKILL)
            if wait(pid) != -signal.SIGKILL:
                break
            found["kills"] += 1
        wrong = of.finish(name)
        failures += [f"run {found['runs']} of seed {seed}: {wrong}"] if wrong else []
        shutil.rmtree(of.folder / name)
    return {"kills": found["kills"], "runs": found["runs"], "seed": seed, "failures": failures}


def crash_points(of: Scene, most: int | None) -> dict[str, Any]:
    """End the process right before every change of the disk, and look at what is left.

    Args:
        of: what is trained.
        most: so many points of each job at most, spread evenly; None takes all.
    """
    return _at_points(of, most, lambda number: lambda: os._exit(CRASHED), short_writes=False)


def failing_writes(of: Scene, most: int | None) -> dict[str, Any]:
    """Let every change of the disk, and every write of a file in its middle, be refused by the system in turn."""

    def refused(number: int) -> Callable[[], None]:
        def refuse() -> None:
            code = _ERRORS[number % len(_ERRORS)]
            raise OSError(code, os.strerror(code))

        return refuse

    return _at_points(of, most, refused, short_writes=True)


def _at_points(
    of: Scene, most: int | None, fault: Callable[[int], Callable[[], None]], short_writes: bool
) -> dict[str, Any]:
    results: dict[str, Any] = {}
    for job, (work, check) in _jobs(of).items():
        points = _count(of, job, work, short_writes)
        step = 1 if most is None else max(points / most, 1.0)
        chosen = sorted({int(step * k) for k in range(points) if step * k < points})
        failures, statuses = list[str](), Counter[str]()
        for number in chosen:
            _prepare(of, job)
            said = of.folder / "said"
            said.unlink(missing_ok=True)

            def disturbed(number: int = number, work: Callable[[], None] = work) -> None:
                with disturbing(number, fault(number), short_writes):
                    work()

            status = wait(start(disturbed, said))
            text = said.read_text() if said.exists() else ""
            statuses[{CRASHED: "ended", 0: "continued", TOLD: "told"}.get(status, "else")] += 1
            wrong = None if status in (CRASHED, 0, TOLD) else f"status {status}: {text[-300:]}"
            wrong = wrong or check()
            failures += [f"{job}, point {number}: {wrong}"] if wrong else []
        results[job] = {"points": points, "tried": len(chosen), **statuses, "failures": failures}
    return results


def _jobs(of: Scene) -> dict[str, tuple[Callable[[], None], Callable[[], str | None]]]:
    """List what writes, each with what must hold after it was disturbed."""
    splat = of.folder / "splat.ply"
    old = of.folder / "old.ply"

    def rewrite() -> None:
        params = {key: value + 0.25 for key, value in load_splat_file(old)[0].items()}
        save_ply(splat, params)

    def old_or_new() -> str | None:
        found = load_splat_file(splat)[0]["means"]
        moved = float((found - load_splat_file(old)[0]["means"]).abs().max())
        return None if moved in (0.0, 0.25) or abs(moved - 0.25) < 1e-6 else "a splat is neither the old nor the new"

    def replaced() -> str | None:
        # whoever looks next finds the old result or the new one, and can train over it
        said = of.folder / "said"
        status = wait(start(lambda: of.train("over", resume=False, overwrite=True), said))
        if status != 0:
            return f"training over it ended with {status}: {said.read_text()[-300:]}"
        return of.finish("over")

    return {
        "train": (lambda: of.train("run"), lambda: of.finish("run")),
        "train --overwrite": (lambda: of.train("over", resume=False, overwrite=True), replaced),
        "write a PLY": (rewrite, old_or_new),
    }


def _prepare(of: Scene, job: str) -> None:
    for name in ("run", "over"):
        shutil.rmtree(of.folder / name, ignore_errors=True)
    if job == "train --overwrite":
        shutil.copytree(of.folder / "whole", of.folder / "over")
    if job == "write a PLY":
        for name in ("splat.ply", "old.ply"):
            shutil.copy(HERE / "splats" / "splat.ply", of.folder / name)


def _count(of: Scene, job: str, work: Callable[[], None], short_writes: bool) -> int:
    """Count the changes of the disk of a job that nobody disturbs."""
    told = of.folder / "count"

    def counted() -> None:
        with disturbing(-1, lambda: None, short_writes) as reached:
            work()
        told.write_text(str(reached[0]))

    _prepare(of, job)
    status = wait(start(counted, of.folder / "said"))
    if status != 0:
        raise RuntimeError(f"{job} ended with {status}: {(of.folder / 'said').read_text()[-2000:]}")
    return int(told.read_text())


@contextmanager
def disturbing(at: int, fault: Callable[[], None], short_writes: bool) -> Iterator[list[int]]:
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
        if mode == "wb" and isinstance(file, Path):
            return io.BufferedWriter(_Meeting(file, meet), 512)
        return plain(file, mode, *words, **named)

    plain, before = builtins.open, [(owner, name, getattr(owner, name)) for owner, name in _CHANGES]
    try:
        for owner, name, function in before:
            setattr(owner, name, wrapped(function))
        if short_writes:
            builtins.open = opening  # type: ignore[assignment]
        yield reached
    finally:
        builtins.open = plain
        for owner, name, function in before:
            setattr(owner, name, function)


class _Meeting(io.FileIO):
    """A file of which half a write gets to the disk before something happens, at the first and the third."""

    def __init__(self, path: Path, meet: Callable[[], None]) -> None:
        super().__init__(path, "w")
        self._meet, self._writes = meet, 0

    def write(self, data: Any) -> int:  # type: ignore[override]
        self._writes += 1
        if self._writes in (1, 3):
            super().write(memoryview(data)[: len(data) // 2])
            self._meet()
            self.seek(-(len(data) // 2), os.SEEK_CUR)
        return super().write(data) or 0


def bit_flips(of: Scene, flips: int, seed: int) -> dict[str, Any]:
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
