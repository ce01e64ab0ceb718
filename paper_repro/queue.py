"""Train the rows that are missing, one after the other: what is done, what it will take, what is lacking for it.

Each row has a process of its own, as `pop-repro run` is, and the queue stops cleanly when asked to. The child decides
whether its row can be trained, so that a queue of days takes up what the clone has learnt meanwhile; a row that another
process trains is left to it, so that several queues can share a folder of results. Hours are those of the paper's GPU:
what its tables print of the row on the dataset, and where they print nothing, POP's times the row's `cost`.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Final

from paper_repro.data_check import check_scene
from paper_repro.jobs import ROWS, Job, NotTrainableError, load_row, trainable
from paper_repro.paper import paper
from paper_repro.results import RESULTS
from paper_repro.scenes import DATASETS, MADE, SCENES, PaperScene
from paper_repro.status import everything, stale_files
from paper_repro.train_row import BusyError, git
from pop_fast.children import ends_with_this, module_command

# of one Gaussian in training: parameters, gradients and two moments in float32; a checkpoint has no gradients
_TRAINING, _CHECKPOINT, _PLY = 4 * 236, 3 * 236, 248
# besides the Gaussians and photographs: the program and its libraries, and what a GPU's renderer lists and sorts
_PROGRAM: Final = 4 * 2**30
# of each of the twelve renders that a row keeps for its figures: render, photograph and dominant Gaussian of a pixel
_RENDERS, _OF_PIXEL = 12, 10
_GIB: Final = 2**30


@dataclass
class Outcome:
    """What became of a queue's jobs, and whether it was stopped."""

    done: list[Job] = field(default_factory=list)
    failed: list[Job] = field(default_factory=list)
    busy: list[Job] = field(default_factory=list)
    impossible: list[Job] = field(default_factory=list)
    stopped: bool = False


class _Child:
    """The one process that trains now, and the wish to stop."""

    def __init__(self) -> None:
        self.stop = False
        self._process: subprocess.Popen[bytes] | None = None

    def request(self, number: int, frame: FrameType | None) -> None:
        """Pass the first Ctrl-C, SIGTERM or SIGHUP on: the child finishes its step, writes a checkpoint and ends."""
        if self._process is not None and not self.stop:
            self._process.terminate()
        self.stop = True

    def run(self, command: Sequence[str], threads: int) -> int:
        environment = {**os.environ, **ends_with_this()}
        if threads > 0:
            environment["OMP_NUM_THREADS"] = str(threads)
        # a session of its own: a terminal's Ctrl-C would reach it as well as what is passed on, and two mean "at once"
        self._process = subprocess.Popen(command, env=environment, start_new_session=True)
        if self.stop:
            self._process.terminate()
        status = self._process.wait()
        self._process = None
        return status


def run_queue(jobs: Sequence[Job], results: Path, words: Sequence[str], threads: int, commit: bool = False) -> Outcome:
    """Train the jobs that have no result yet, in the order given.

    Args:
        jobs: what to train.
        results: the folder of results.
        words: further words of `pop-repro run`: --data and the like.
        threads: CPU threads of a training.
        commit: commit each result in git, with the pages that are made from the package's results.

    Returns:
        What became of them; a failed row does not keep the next ones from being trained.
    """
    outcome, missing = Outcome(), [job for job in jobs if not job.is_done(results)]
    print(f"{len(jobs) - len(missing)} of {len(jobs)} rows are done; {len(missing)} to go", flush=True)
    with _stoppable() as child:
        for number, job in enumerate(missing, 1):
            if child.stop:
                break
            if job.is_done(results):
                # another queue was there first
                outcome.done.append(job)
                continue
            print(f"[{number}/{len(missing)}] {job}", flush=True)
            start = time.monotonic()
            status = child.run(module_command("paper_repro", "run", *str(job).split(), *words), threads)
            kinds = {0: outcome.done, BusyError.status: outcome.busy, NotTrainableError.status: outcome.impossible}
            if child.stop and status != 0:
                break
            kinds.get(status, outcome.failed).append(job)
            if status != 0:
                print(f"[{number}/{len(missing)}] {job} {_why(status)}", flush=True)
            else:
                print(f"[{number}/{len(missing)}] done after {(time.monotonic() - start) / 60:.1f} min", flush=True)
                if commit:
                    _commit(job, results)
        outcome.stopped = child.stop
    return outcome


def _why(status: int) -> str:
    """Say what became of a row, at once: the queue's own end may be days away."""
    if status < 0:
        return f"was killed by {signal.Signals(-status).name}; the queue continues with it when it is run again"
    told = {BusyError.status: "is trained by another process", NotTrainableError.status: "cannot be trained"}
    return told.get(status, f"failed with status {status}; its last lines say why")


@contextmanager
def _stoppable() -> Iterator[_Child]:
    child = _Child()
    numbers = [signal.SIGINT, signal.SIGTERM]
    # SIGHUP stays ignored where it is, as under nohup
    numbers += [signal.SIGHUP] if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else []
    before = {number: signal.signal(number, child.request) for number in numbers}
    try:
        yield child
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _commit(job: Job, results: Path) -> None:
    path = job.file(results).resolve()
    paths = [str(each) for each in (path, *(_pages(path.parent) if results.resolve() == RESULTS else []))]
    message = f"Result: {job.row.name} on {job.scene.name}, {job.scale.name} scale, seed {job.seed}"
    for command in (["add"], ["commit", "--quiet", "-m", message]):
        done = git(path.parent, *command, "--", *paths)
        if done.returncode != 0:
            print(f"pop-repro: git {command[0]} {path.name} failed: {done.stderr.strip()}", file=sys.stderr)
            return


def _pages(folder: Path) -> list[Path]:
    """Write what is made from the package's results, but for pages that somebody edits just now; give what changed."""
    stale = stale_files(everything())
    unedited = [path for path in stale if not git(folder, "status", "--porcelain", "--", str(path)).stdout]
    for path in unedited:
        path.write_text(stale[path], encoding="utf-8")
    return unedited


def state(job: Job, results: Path, work: Path) -> str:
    """Say how far a job is: "done", "step 1,500", "to do" or "not in this version"."""
    if job.is_done(results):
        return "done"
    from pop_fast.train.checkpoint import list_checkpoints

    found = list_checkpoints(job.work(work))
    if found:
        return f"step {found[-1][0] + 1:,}"
    return "to do" if trainable(job) else "not in this version"


def progress(jobs: Sequence[Job], results: Path, work: Path) -> list[str]:
    """Write a grid of rows by scenes, and one line of counts.

    Args:
        jobs: of one scale.
        results: the folder of results.
        work: the folder of checkpoints.
    """
    cells: dict[tuple[str, str], list[str]] = {}
    for job in jobs:
        cells.setdefault((job.row.name, job.scene.name), []).append(state(job, results, work))
    # in the order of the tables and of the scales, whatever the order of the jobs
    rows = [row for row in ROWS if any(row == name for name, _ in cells)]
    scenes = [scene for scene in SCENES if any(scene == name for _, name in cells)]
    shown = {key: _merged(states) for key, states in cells.items()}
    first = max(map(len, rows))
    widths = [max(len(scene), *(len(shown.get((row, scene), "")) for row in rows)) for scene in scenes]
    lines = ["  ".join(["".ljust(first), *(scene.ljust(width) for scene, width in zip(scenes, widths, strict=True))])]
    for row in rows:
        texts = (shown.get((row, scene), "").ljust(width) for scene, width in zip(scenes, widths, strict=True))
        lines.append("  ".join([row.ljust(first), *texts]))
    done = sum(states.count("done") for states in cells.values())
    lines.append(f"{done} of {len(jobs)} done")
    return [line.rstrip() for line in lines]


def _merged(states: Sequence[str]) -> str:
    """Merge what is said of several seeds."""
    done = states.count("done")
    rest = [state for state in states if state != "done"]
    if done == 0 or not rest:
        return ", ".join(dict.fromkeys(states)) + (f" x {done}" if done > 1 else "")
    return f"{done} done, {', '.join(dict.fromkeys(rest))}"


def hours(job: Job) -> float | None:
    """Return the hours that a training takes of the paper's GPU; None of a scene that the paper does not report."""
    if not job.scene.in_paper:
        return None
    own = _printed(job.row.name, job.scene, "time_s")
    pop = max(_printed("pop", job.scene, "time_s"))
    return (max(own) if own else pop * job.row.cost) / 3600.0


def hours_by_row(jobs: Sequence[Job]) -> list[str]:
    """Write the hours of each row over its scenes and seeds, and their sum; nothing where none is known."""
    found: dict[str, float] = {}
    for job in jobs:
        taken = hours(job)
        if taken is not None:
            found[job.row.name] = found.get(job.row.name, 0.0) + taken
    if not found:
        return []
    width = max(map(len, found))
    lines = [f"{name:<{width}}  {taken:6.1f} h" for name, taken in found.items()]
    gpu = paper().stated["gpu"].value
    source = "by the paper's times, or by a row's cost where it prints none"
    if shorter := [name for name in found if load_row(name).base is not None]:
        source += f"; less for {', '.join(shorter)}, where the row that they begin from is finished in --work"
    return [*lines, f"{sum(found.values()):.1f} hours of one {gpu} in all, {source}"]


def lacking(jobs: Sequence[Job], data: Path, work: Path, backend: str) -> list[str]:
    """Say what is lacking for some trainings: each point in a line that names the fix.

    Args:
        jobs: to be trained one after the other.
        data: the folder that holds the scenes.
        work: the folder of checkpoints.
        backend: as `pop train --backend`.
    """
    if not jobs:
        return []
    return [*_data(jobs, data), *_disk(jobs, work), *_memory(jobs), *_gpu(jobs, backend)]


def _data(jobs: Sequence[Job], data: Path) -> list[str]:
    scenes = {job.scene.name: job.scene for job in jobs if job.scene.name not in MADE}
    found = [check_scene(scene, data) for scene in scenes.values()]
    return [f"data: {item.scene.name} is {item.status}: {item.reason}" for item in found if item.status != "ok"]


def _disk(jobs: Sequence[Job], work: Path) -> list[str]:
    pixels = [job.scene.size[0] * job.scene.size[1] / job.factor**2 for job in jobs]
    needed = _RENDERS * _OF_PIXEL * sum(pixels) + max(map(_gaussians, jobs)) * (2 * _CHECKPOINT + _PLY)
    place = next(folder for folder in (work.absolute(), *work.absolute().parents) if folder.is_dir())
    free = shutil.disk_usage(place).free
    if free >= needed:
        return []
    return [
        f"disk: {len(jobs)} trainings leave up to {needed / _GIB:.0f} GiB in {work}, where {free / _GIB:.0f} GiB are "
        "free; name another folder with --work"
    ]


def _memory(jobs: Sequence[Job]) -> list[str]:
    from pop_fast.machine import free_bytes

    def needed_by(job: Job) -> float:
        photographs = job.scene.n_images * job.scene.size[0] * job.scene.size[1] / job.factor**2 * 3
        return photographs + _gaussians(job) * _TRAINING + _PROGRAM

    largest = max(jobs, key=needed_by)
    needed, free = needed_by(largest), free_bytes()
    if free is None or free >= needed:
        return []
    what = f"{largest.row.name} on {largest.scene.name} takes about {needed / _GIB:.0f} GiB"
    return [f"memory: {what}, and {free / _GIB:.0f} GiB are free; end other programs, or leave it out with --scenes"]


def _gpu(jobs: Sequence[Job], backend: str) -> list[str]:
    from pop_fast.api.backend import get_backend

    on_gpu = backend == "auto" or get_backend(backend).device == "cuda"
    if not on_gpu or not any(job.scale.name == "paper" for job in jobs):
        return []
    import torch

    if not torch.cuda.is_available():
        return [
            "GPU: there is no NVIDIA GPU here, and a CPU takes far longer than these hours; run it where there is one, "
            "or train on the CPU anyway with --backend compiled"
        ]
    total = torch.cuda.get_device_properties(0).total_memory
    needed = max(map(_gaussians, jobs)) * _TRAINING + _PROGRAM
    if total >= needed:
        return []
    return [f"GPU: it has {total / _GIB:.0f} GiB, and the largest training takes about {needed / _GIB:.0f} GiB"]


def _gaussians(job: Job) -> float:
    """Return how many Gaussians a training comes to, as far as the paper says: its own number, or the largest there."""
    if not job.scene.in_paper:
        # these captures are smaller than the paper's
        return 2e6
    own = _printed(job.row.name, job.scene, "num_gaussians_k")
    return 1e3 * max(own or _printed(None, job.scene, "num_gaussians_k"))


def _printed(row: str | None, scene: PaperScene, metric: str) -> list[float]:
    """List what the tables print of a row on a scene's dataset, of all rows for None."""
    dataset = DATASETS[scene.dataset].name
    lines = [line for table in paper().tables if dataset in table.datasets for line in table.rows]
    values = [line.values[dataset].get(metric) for line in lines if row in (None, line.row)]
    return [value for value in values if value is not None]
