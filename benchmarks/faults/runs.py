"""Runs as users start them, killed at random moments: they go on to the same bits.

Every run is `pop train`, called in a child that has imported everything already, so that it may die in every way and
starts at once: by the native step, on two ranks that find each other as torchrun lets them, and in two blocks. A part
of a run in blocks, and a rank, is a child as well.
"""

from __future__ import annotations

import io
import os
import random
import resource
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

import pop_fast.compiled
from pop_fast.blocks import jobs
from pop_fast.cli import main
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.results import ResultFolder

from .corpus import HERE

STEPS, EVERY = 16, 4
# growth, pruning, checkpoints, measurements and files in between; the report's extra renders are left out
_WORDS: Final = (
    *("--backend", "compiled", "--max-steps", str(STEPS), "--checkpoint-every", str(EVERY)),
    *("--eval-steps", "8", "--save-steps", "8", "--test-every", "3", "--ssim-padding", "same", "--max-renders", "1"),
    *("--pop.refine-start-iter", "2", "--pop.refine-stop-iter", "14", "--pop.refine-every", "4"),
    *("--pop.grow-grad2d", "1e-5", "--pop.pop-stop-iter", "14"),
    *("--no-progress", "--quiet", "--skip-checks", "--skip-sizes"),
)
# of one run, after which it is left alone to its end
MOST_KILLS: Final = 6
# of a process whose fellow has ended, as torchrun does
_GRACE, _PATIENCE = 0.2, 5.0
# of a child that ended in an exception which the command line would have shown as a traceback
TRACEBACK = 70
# and in one that it would have told in a line
TOLD = 2


@dataclass(frozen=True)
class Kind:
    """A way to start a run."""

    words: tuple[str, ...]  # further ones of `pop train`
    ranks: int  # processes that train together
    stepper: str | None  # what must have taken the steps


KINDS: Final = {
    "native step": Kind((), 1, "native"),
    "two ranks": Kind(("--batch-size", "2"), 2, "torch"),
    "blocks 2x1": Kind(("--blocks", "2x1", "--blocks-rounds", "0"), 1, None),
}


@dataclass(frozen=True)
class UndisturbedRun:
    """What is trained and how, and what a run of it that nobody disturbs ends with."""

    kind: Kind  # how runs are started
    capture: Path  # the folder of photographs
    folder: Path  # where runs write
    whole: dict[str, Any]  # what a run ends with; of ranks, one process that draws all views

    def train(self, name: str, *more: str, threads: int = 1) -> int:
        """Call `pop train` in this process, which is one of `kind.ranks`, and return its status."""
        out = ("--out", str(self.folder / name), "--threads", str(threads))
        with redirect_stdout(io.StringIO()):
            return main(["train", str(self.capture), *_WORDS, *self.kind.words, *out, *more])

    def together(self, works: Sequence[Callable[[], int]], said: Path) -> tuple[list[int], list[int]]:
        """Start the processes of a run, and return their numbers; see `ended`."""
        if len(works) == 1:
            return [start(works[0], said)], []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        told = {"WORLD_SIZE": str(len(works)), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}

        def ranked(rank: int) -> int:
            os.environ.update(told, RANK=str(rank))
            return works[rank]()

        pids = [start(lambda rank=rank: ranked(rank), said) for rank in range(len(works))]
        return pids[:1], pids[1:]

    def run(self, name: str, *more: str, threads: int = 1) -> tuple[int, str]:
        """Train until the end in children, and return the status of the one that writes, and what they said."""
        said = self.folder / "said"
        said.unlink(missing_ok=True)
        work = lambda: self.train(name, *more, threads=threads)  # noqa: E731  the same for every rank
        status = ended(*self.together([work] * self.kind.ranks, said))
        return status, said.read_text()

    def finish(self, name: str, *more: str) -> str | None:
        """Continue a run until its end; say what is wrong with what it ends with, or None."""
        status, said = self.run(name, *(more or ("--resume",)))
        if status != 0:
            return f"continuing ended with {status}: {said[-300:]}"
        if not same(ended_with(self.folder / name), self.whole):
            return "the bits differ"
        left = [
            str(path.relative_to(self.folder))
            for path in (self.folder / name).rglob("*")
            if "partial" in path.name or "replaced" in path.name
        ]
        return f"{left} is left" if left else None


def ended(writer: Sequence[int], others: Sequence[int]) -> int:
    """Wait for the processes of a run and return the writer's status; where one fails the others are stopped."""
    left, statuses, since = {*writer, *others}, dict[int, int](), 0.0
    while left:
        for pid in list(left):
            found, status = os.waitpid(pid, os.WNOHANG)
            if found:
                statuses[pid] = os.waitstatus_to_exitcode(status)
                left.remove(pid)
        failed = any(statuses.values())
        if failed and left:
            since = since or time.monotonic()
            late = time.monotonic() - since
            for pid in left if late > _GRACE else ():
                os.kill(pid, signal.SIGKILL if late > _PATIENCE else signal.SIGTERM)
                time.sleep(0.05)
        time.sleep(0.005)
    return statuses[writer[0]]


def why_not() -> str | None:
    """Say why runs of the native step cannot be tried here, or None."""
    return pop_fast.compiled.why_not()


@contextmanager
def scene(kind: str) -> Iterator[UndisturbedRun]:
    """Train once, undisturbed, in this process, which then has imported all that its children need."""
    run_parts(in_children=True)
    # a child has none of its parent's threads, and waits for ever to dismiss a pool that torch had made here
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        capture = HERE / "colmap"
        if kind.startswith("blocks"):
            capture = Path(folder) / "toy"
            with redirect_stdout(io.StringIO()):
                main(["demo", str(capture), "--views", "8", "--width", "40", "--height", "32"])
        made = UndisturbedRun(KINDS[kind], capture, Path(folder), {})
        status = made.train("whole")
        stats = ResultFolder(Path(folder) / "whole").read_stats("val", STEPS - 1) or {}
        stepper = made.kind.stepper or stats.get("stepper")
        if status != 0 or stats.get("stepper") != stepper:
            raise RuntimeError(f"{kind}: status {status}, steps by {stats.get('stepper')}")
        made.whole.update(ended_with(Path(folder) / "whole"))
        yield made


def run_parts(in_children: bool) -> None:
    """Let the parts of a run in blocks be done without an import: in children of their starter, or in its own process.

    Args:
        in_children: as outside; if not, every change of the disk is one of a single process, which can be numbered.
    """

    def run_part(words: Sequence[str], quiet: bool) -> int:
        told = list(words[words.index("pop_fast.cli") + 1 :])
        return wait(start(lambda: main(told), Path(os.devnull))) if in_children else main(told)

    jobs._run = run_part
    jobs.has_snakemake = lambda: False


def ended_with(folder: Path) -> dict[str, Any]:
    """Return what a finished run's last checkpoint holds, but for the clock and the number of threads."""
    path = ckpt.checkpoint_path(folder, STEPS - 1)
    if (folder / "blocks").is_dir():
        # merged blocks cannot be resumed: they have Gaussians alone
        return {"splats": ckpt.load_splats(path)[0]}
    content = ckpt.load_checkpoint(path)
    free = ("seconds", "metrics_bytes", "threads", "config")
    config = {key: value for key, value in content.get("config", {}).items() if key != "threads"}
    return {**{key: value for key, value in content.items() if key not in free}, "config": config}


def same(a: Any, b: Any) -> bool:
    """Compare nested values bit by bit."""
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    return type(a) is type(b) and a == b


def kill_loop(of: UndisturbedRun, kills: int, minutes: float, seed: int) -> dict[str, Any]:
    """Kill runs at random moments, each at most so often, with one thread or two by turns, then let them end.

    Of two ranks one is killed, or both at once; of a run in blocks the starter with the part that it waits for.

    Args:
        of: what is trained.
        kills: at least.
        minutes: at least.
        seed: decides when, and which processes.
    """
    rng, end = random.Random(seed), time.monotonic() + 60.0 * minutes
    begun = time.monotonic()
    of.run("timed")
    longest, count, failures = time.monotonic() - begun, Counter[str](), list[str]()
    while count["kills"] < kills or time.monotonic() < end:
        name = f"killed_{count['runs']}"
        count["runs"] += 1
        for turn in range(MOST_KILLS):
            if not _killed(of, name, 1 + turn % 2, rng, longest):
                break
            count["kills"] += 1
        wrong = of.finish(name)
        failures += [f"run {count['runs']} of seed {seed}: {wrong}"] if wrong else []
        shutil.rmtree(of.folder / name)
    return {"kills": count["kills"], "runs": count["runs"], "seed": seed, "failures": failures}


def _killed(of: UndisturbedRun, name: str, threads: int, rng: random.Random, longest: float) -> bool:
    """Start or continue a run, kill it at a random moment, and tell whether that was before its end."""

    def work() -> int:
        # a group of its own, with the parts that it starts
        os.setpgid(0, 0)
        return of.train(name, "--resume", threads=threads if of.kind.ranks == 1 else 1)

    writer, others = of.together([work] * of.kind.ranks, of.folder / "said")
    time.sleep(rng.uniform(0.0, longest))
    whom = [rng.choice([*writer, *others])] if others and rng.random() < 0.5 else [*writer, *others]
    for pid in whom:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return ended(writer, others) != 0


def start(work: Callable[[], int | None], said: Path, memory: int | None = None) -> int:
    """Begin some work in a child.

    Args:
        work: done there; what it returns is the child's exit status, and None is 0.
        said: where what it prints goes.
        memory: bytes of address space that it may take over what this process has.

    Returns:
        The child's process id.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    status = TRACEBACK
    try:
        out = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(out, 1)
        os.dup2(out, 2)
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if memory is not None:
            have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (have + memory, have + memory))
        status = work() or 0
    except BaseException as error:
        from pop_fast.cli import describe

        line = describe(error)
        if line is not None and "\n" not in line and len(line) < 1000:
            status = TOLD
            print(line, flush=True)
        else:
            traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def wait(pid: int) -> int:
    """Wait for a child; a signal that ended it is a negative status."""
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
