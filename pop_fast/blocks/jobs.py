"""The parts of a run in blocks (trainings of blocks, and merges), where each one writes, and how they are run.

Round 0 trains every block by itself, or a coarse model of the whole. The rounds after it begin with the merged
Gaussians: every block trains those of its own core, among all others as they are. A round's blocks do not wait for one
another; its merge waits for all of them, and the next round for the merge.

Parts are run by Snakemake where it is installed, else one after the other. Either way a part is its own process,
`pop blocks train OUT i_j` or `pop blocks merge OUT`, so that its memory is given back when it ends. One that is
finished has left its marker and is not done again; a block that was interrupted resumes from its last checkpoint.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pop_fast.api.backend import get_backend
from pop_fast.blocks.plan import COARSE, FOLDER, Job
from pop_fast.children import SAFE_PATH, ends_with_this, module_command
from pop_fast.errors import PopError
from pop_fast.io.atomic import FolderLock
from pop_fast.train.choose import count_gpus
from pop_fast.train.signals import stop_requests


@dataclass(frozen=True)
class Part:
    """A training of a block, or a merge."""

    round: int  # which it belongs to, from 0
    block: str | None  # which is trained; None merges all
    last: bool = False  # whether it is the last merge, which writes the run's result

    @property
    def name(self) -> str:
        """Return its name in the workflow."""
        own = "merge" if self.block is None else f"block_{self.block}"
        return own if self.last or (self.round == 0 and self.block) else f"round_{self.round}_{own}"

    def words(self, folder: Path) -> list[str]:
        """Return the words after `pop blocks` that do it."""
        own = ["merge", str(folder)] if self.block is None else ["train", str(folder), self.block]
        plain = self.last or (self.round == 0 and self.block is not None)
        return own if plain else [*own, "--round", str(self.round)]

    def marker(self, folder: Path) -> Path:
        """Return the file that says that it is done."""
        return marker_of(folder, self.block, None if self.last else self.round)


def parts_of(job: Job) -> list[Part]:
    """List the parts of a run, in an order in which they can be done."""
    found = []
    for number in range(job.rounds + 1):
        found += [Part(number, name) for name in (job.names if number else job.trained_first)]
        found.append(Part(number, None, last=number == job.rounds))
    return found


def round_folder(folder: Path, number: int) -> Path:
    """Return the folder of a round: of what its merge leaves to the next one and, from round 1, of its blocks."""
    return folder / FOLDER / f"round_{number}"


def block_folder(folder: Path, name: str, number: int = 0) -> Path:
    """Return the folder of what a block is trained on or, from round 1, of what it is trained to in a round."""
    return (round_folder(folder, number) if number else folder / FOLDER) / name


def result_of(folder: Path, name: str, number: int = 0) -> Path:
    """Return the result folder of a block of the run in `folder`, in a round."""
    return block_folder(folder, name, number) / "result"


def core_of(folder: Path, name: str, number: int) -> Path:
    """Return the file of the merged Gaussians in a block's core after a round that is not the last."""
    return round_folder(folder, number) / f"{name}.pt"


def marker_of(folder: Path, name: str | None, number: int | None = 0) -> Path:
    """Return the file that says that a block is trained in a round or, of no block, that all are merged.

    Args:
        number: the round; None is the last one, of the merge.
    """
    if name is not None:
        return block_folder(folder, name, number or 0) / "trained"
    return folder / FOLDER / "merged" if number is None else round_folder(folder, number) / "merged"


SNAKEFILE: Final = Path(__file__).with_name("Snakefile")
_INSTALL: Final = "pip install 'pop-splatting[blocks]' brings it"
# s between looks at a process and at whether to stop
_PAUSE: Final = 0.1


def has_snakemake() -> bool:
    """Tell whether Snakemake is installed."""
    return importlib.util.find_spec("snakemake") is not None


def profile_folder(name: str) -> Path:
    """Find a Snakemake profile: a folder, or one of those that come with the program.

    Raises:
        PopError: there is none, or Snakemake is not installed.
    """
    if not has_snakemake():
        raise PopError(f"--blocks-profile {name} needs Snakemake; {_INSTALL}")
    own = SNAKEFILE.parent / "profiles"
    shipped = {path.name: path for path in sorted(own.iterdir()) if path.name != "default"}
    found = shipped.get(name, Path(name))
    if not (found / "config.yaml").is_file():
        raise PopError(
            f"--blocks-profile {name}: is neither one of {', '.join(shipped)} nor a folder with a config.yaml"
        )
    return found.absolute()


def run_in_turn(folder: Path, job: Job, quiet: bool = False, say: Callable[[str], None] = print) -> int:
    """Do the parts that are not done yet, one after the other: train the blocks, merge them, and so in every round.

    Args:
        quiet: what they print is not shown; warnings and errors are.

    Returns:
        The exit status of the first part that failed, or 0; 130 after Ctrl-C or SIGTERM.
    """
    for part in parts_of(job):
        if part.marker(folder).is_file():
            continue
        say(_begins(part, job))
        status = _run(module_command("pop_fast.cli", "blocks", *part.words(folder)), quiet)
        if status != 0:
            return status
    return 0


def _begins(part: Part, job: Job) -> str:
    count = len(job.names)
    of_round = f"round {part.round} of {job.rounds}: " if part.round else ""
    if part.block is None:
        what = "dividing the coarse model into" if job.coarse and part.round == 0 else "merging"
        return f"{of_round}{what} {count} blocks"
    if part.block == COARSE:
        return f"the coarse model of the whole, photographs shrunk by {job.coarse}"
    return f"{of_round}block {part.block}, {job.names.index(part.block) + 1} of {count}"


def gpus_for(backend: str) -> int:
    """Return how many GPUs of this machine blocks can be trained on at a time by a backend."""
    return count_gpus() if get_backend(backend).device == "cuda" else 0


@contextmanager
def own_gpu(folder: Path, backend: str) -> Iterator[None]:
    """Train on a GPU that no other block of a run is trained on; PopError where one is trained on each."""
    count = gpus_for(backend)
    lock = _free_gpu(folder, count) if count > 1 else None
    try:
        yield
    finally:
        if lock is not None:
            lock.release()


def _free_gpu(folder: Path, count: int) -> FolderLock:
    import torch

    for number in range(count):
        # a folder that several machines share has a lock for each of their GPUs
        lock = FolderLock(folder / FOLDER / "gpus" / f"{platform.node() or 'machine'}_{number}")
        lock.path.mkdir(parents=True, exist_ok=True)
        try:
            lock.take()
        except PopError:
            continue
        torch.cuda.set_device(number)
        return lock
    raise PopError(f"{folder}: a block is trained on each of the {count} GPUs; wait until one is done")


def run_workflow(
    folder: Path, job: Job, jobs: int, threads: int, backend: str, profile: Path | None, quiet: bool = False
) -> int:
    """Run the workflow by Snakemake.

    Args:
        jobs: how many blocks are trained at a time on this machine; as many as it has GPUs where one trains.
        backend: what trains; one on a GPU asks for one each.
        profile: a profile's folder, by which it runs on a cluster; None stays here.
        quiet: what it prints is not shown; warnings and errors are.

    Returns:
        The exit status: Snakemake's, or 130 after Ctrl-C or SIGTERM.
    """
    more = ["--quiet", "all"] if quiet else []
    # after Ctrl-C Snakemake cancels a cluster's jobs, for which it waits after SIGTERM
    return _run(workflow_words(folder, job, jobs, threads, backend, profile, *more), quiet, signal.SIGINT)


def workflow_words(
    folder: Path, job: Job, jobs: int, threads: int, backend: str, profile: Path | None, *more: str
) -> list[str]:
    """Return the command that runs the workflow, with further words for Snakemake; see `run_workflow`."""
    place = folder.absolute()
    each = threads or os.cpu_count() or 1
    gpus = gpus_for(backend)
    many = min(gpus or jobs, len(job.names))
    # the caller holds the lock of the folder
    here = ["--cores", str(each * many), "--resources", f"gpu={max(gpus, 1)}", "--nolock"]
    where = here if profile is None else ["--profile", str(profile), "--nolock"]
    command = module_command("snakemake", "-s", str(SNAKEFILE), "--directory", str(place / FOLDER))
    settings = {"folder": place, "threads": each, "gpus": int(get_backend(backend).device != "cpu")}
    return [*command, *where, *more, "--config", *(f"{name}={value}" for name, value in settings.items())]


def _run(words: Sequence[str], quiet: bool, passed: signal.Signals = signal.SIGTERM) -> int:
    """Run a process and wait; the first Ctrl-C, SIGTERM or SIGHUP is passed on once to it and its children.

    It is passed on as SIGTERM, which ends a Python that is still being loaded without a traceback.
    """
    alone = os.name == "posix"
    with stop_requests() as stop:
        shown = subprocess.DEVNULL if quiet else None
        environment = {**os.environ, **SAFE_PATH, **ends_with_this()}
        process = subprocess.Popen(words, start_new_session=alone, stdout=shown, env=environment)
        try:
            while process.poll() is None:
                if stop.asked:
                    _interrupt(process, alone, passed)
                    process.wait()
                    return 128 + signal.SIGINT
                time.sleep(_PAUSE)
        except BaseException:
            process.kill()
            process.wait()
            raise
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


def _interrupt(process: subprocess.Popen[bytes], alone: bool, number: signal.Signals) -> None:
    if alone:
        os.killpg(process.pid, number)
    else:
        process.terminate()
