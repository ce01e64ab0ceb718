"""Train the rows that are missing one after the other, each in a process of its own, and stop cleanly when asked to.

The child is what `pop-repro run` is. It decides whether its row can be trained, so that a queue of days takes up what
the clone has learnt meanwhile; a row that another process trains is left to it, so that several queues can share a
folder of results.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

from paper_repro.jobs import Job, NotTrainableError
from paper_repro.results import RESULTS
from paper_repro.status import everything, stale_files
from paper_repro.train_row import BusyError
from pop_fast.children import module_command


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
        """Pass the first Ctrl-C or SIGTERM on: the child finishes its step, writes a checkpoint and ends."""
        if self._process is not None and not self.stop:
            self._process.terminate()
        self.stop = True

    def run(self, command: Sequence[str], threads: int) -> int:
        environment = dict(os.environ)
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
        commit: commit each result in git when it is there, with the pages that are made from the package's results.

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
            status = child.run(module_command("paper_repro", "run", *_words_of(job), *words), threads)
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
        return f"was killed by {signal.Signals(-status).name}; the queue, called again, continues with it"
    told = {BusyError.status: "is left to another process", NotTrainableError.status: "cannot be trained"}
    return told.get(status, f"failed with status {status}; its last lines say why")


@contextmanager
def _stoppable() -> Iterator[_Child]:
    child = _Child()
    before = {number: signal.signal(number, child.request) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield child
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _words_of(job: Job) -> list[str]:
    return [job.row.name, job.scene.name, "--scale", job.scale.name, "--seed", str(job.seed)]


def _commit(job: Job, results: Path) -> None:
    path = job.file(results).resolve()
    paths = [str(each) for each in (path, *(_pages(path.parent) if results.resolve() == RESULTS else []))]
    message = f"Result: {job.row.name} on {job.scene.name}, {job.scale.name} scale, seed {job.seed}"
    for command in (["add"], ["commit", "--quiet", "-m", message]):
        done = _git(path.parent, *command, "--", *paths)
        if done.returncode != 0:
            print(f"pop-repro: git {command[0]} {path.name} failed: {done.stderr.strip()}", file=sys.stderr)
            return


def _pages(folder: Path) -> list[Path]:
    """Write what is made from the package's results, but for pages that somebody edits just now; give what changed."""
    stale = stale_files(everything())
    unedited = [path for path in stale if not _git(folder, "status", "--porcelain", "--", str(path)).stdout]
    for path in unedited:
        path.write_text(stale[path], encoding="utf-8")
    return unedited


def _git(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", "-C", str(folder), *words], capture_output=True, text=True, check=False)
