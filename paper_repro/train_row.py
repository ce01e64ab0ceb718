"""Train one row: through what `pop train` itself runs, resumable in the middle, and leave its result as one file."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro import prepared, results
from paper_repro.base import begin_from_base, keep_for_others, remove_what_was_kept, steps_for_others
from paper_repro.jobs import WORK, Job
from paper_repro.record import COMMIT
from paper_repro.results import Result
from paper_repro.scenes import MADE, PaperScene, find_folder
from pop_fast.errors import PopError

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

# of a work folder: what finished rows leave to be published
PUBLISHED: Final = "published"
_DEMO_SEED: Final = 0
# of a result folder: what takes space and a finished row does not need
_CHECKPOINTS, _PLY = "ckpts", "ply"


class BusyError(PopError):
    """Say that another process trains this row.

    Attributes:
        status: the exit status of `pop-repro run`, by which a queue tells it from a failure.
    """

    status: Final = 75


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a row is trained, none of which changes what it is.

    Attributes:
        data: the folder that holds the scenes.
        results: the folder of results.
        work: the folder of checkpoints; what is in it for a row can be removed once the row is finished.
        threads: CPU threads; 0 takes all cores.
        backend: as `pop train --backend`.
        checkpoint_every: steps that a kill can cost; None takes the scale's.
        log_every: steps between two points of the curve; None takes the scale's.
        lpips_vgg: weights of LPIPS on VGG16.
        lpips_alex: weights of LPIPS on AlexNet.
        published: the folder of what finished rows leave to be published; None takes "published" in the work folder.
        again: train a row that is finished again, and replace its result.
        keep_ply: keep the Gaussians in the work folder.
        keep_checkpoints: keep the checkpoints too.
        untimed: its seconds are not compared, because the machine has other work meanwhile.
        quiet: no progress bar.
    """

    data: Path
    results: Path = results.RESULTS
    work: Path = WORK
    threads: int = 1
    backend: str = "auto"
    checkpoint_every: int | None = None
    log_every: int | None = None
    lpips_vgg: tuple[str, ...] = ()
    lpips_alex: tuple[str, ...] = ()
    published: Path | None = None
    again: bool = False
    keep_ply: bool = False
    keep_checkpoints: bool = False
    untimed: bool = False
    quiet: bool = False


def finished(job: Job, folder: Path) -> Result | None:
    """Return the result of a job; None where it has none.

    Raises:
        PopError: it has one that is damaged, or that was trained with settings that are no longer the row's.
    """
    result = job.result(folder)
    if result is not None:
        from paper_repro.collect import first_change

        change = first_change(result, job.config())
        if change is not None:
            raise PopError(
                f"{job.file(folder)}: {job.scene.name}, seed {job.seed} was trained with {change}; train it again "
                "with --again"
            )
    return result


def train_row(job: Job, options: Options) -> Result:
    """Train a job, or continue with it, and write its result; where it has one, nothing is done.

    Returns:
        The result.

    Raises:
        PopError: the program lacks the method, the scene is absent or is not what it must be, or as `TrainingRun`.
        BusyError: another process trains it.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when a checkpoint has been written.
    """
    work = job.work(options.work)
    before = None if options.again else finished(job, options.results)
    if before is not None:
        return before
    # a row that cannot be trained is said before anything is made
    job.config()
    config = _config(job, options, work)
    with only_one(work.with_suffix(".lock"), f"{job}: another process trains it"):
        # that process may have finished it meanwhile
        result = None if options.again else job.result(options.results)
        if result is None:
            _train(job, options, config)
            from paper_repro.collect import collect
            from paper_repro.published import publish

            published = options.published or options.work / PUBLISHED
            result = collect(job, work, publish(job, work, published, config.max_steps - 1))
            results.write(result, options.results)
        _remove_bulk(job, options)
    return result


def capture_folder(scene: PaperScene, options: Options) -> Path:
    """Find a scene's capture; one that the program makes is made where it is absent.

    Raises:
        PopError: it is not there; says where it comes from.
    """
    if scene.name not in MADE:
        return find_folder(scene, options.data)
    folder = options.work / scene.folder
    with only_one(options.work / f"{scene.folder}.lock", f"{folder}: another process makes it", wait=True):
        if not folder.is_dir():
            from pop_fast.demo import make_demo

            (width, height), views = scene.size, scene.n_images
            make_demo(folder, seed=_DEMO_SEED, views=views, width=width, height=height)
    return folder


def commit() -> str | None:
    """Return the commit of the clone that this runs from, "-dirty" where its files differ from it; None outside one.

    What the environment says comes first (`POP_COMMIT`, as for `cuda_ext.gpu_check`): files that were sent to a node.

    Raises:
        PopError: it says something else than a commit.
    """
    told = os.environ.get("POP_COMMIT", "")
    if told:
        if re.fullmatch(COMMIT, told) is None:
            raise PopError(f"POP_COMMIT is {told!r}; it must be 7 to 40 hex digits of a git commit, or unset")
        return told
    here = Path(__file__).resolve().parents[1]
    git = ["git", "-C", str(here)]
    try:
        asked = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        # results are added while rows are trained, and change nothing
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--untracked-files=no", "--", ":!paper_repro/results"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return asked.stdout.strip() + ("-dirty" if changed.stdout.strip() else "")


@contextlib.contextmanager
def only_one(path: Path, busy: str, wait: bool = False) -> Iterator[None]:
    """Hold a lock file for the block; the lock ends with the process, however that ends.

    Args:
        path: the lock file.
        busy: what to say where another process holds it.
        wait: wait for it instead.

    Raises:
        BusyError: another process holds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise BusyError(busy) from error
        yield


def _config(job: Job, options: Options, work: Path) -> TrainConfig:
    said: dict[str, Any] = {"threads": options.threads, "backend": options.backend}
    every = {"checkpoint_every": options.checkpoint_every, "log_every": options.log_every}
    said |= {name: value for name, value in every.items() if value is not None}
    # a checkpoint of such a step is not removed for the next one
    said["save_steps"] = steps_for_others(job)
    said |= {"lpips_vgg": options.lpips_vgg, "lpips_alex": options.lpips_alex, "progress": not options.quiet}
    return job.config(data=str(capture_folder(job.scene, options).absolute()), result_dir=str(work), **said)


def _train(job: Job, options: Options, config: TrainConfig) -> None:
    from paper_repro.collect import BESIDE, spacing, state_of_data
    from paper_repro.data_check import check_capture
    from pop_fast.cli.train import check_backend
    from pop_fast.train.choose import choose_backend

    # asked before the hours of training, in which the clone may move on
    program = commit()
    config, chosen = choose_backend(config, True)
    check_backend(config)
    capture, seconds = load_capture_of(job, config)
    check_capture(job, config, capture)
    base = _begin(job, options, config, capture)
    from paper_repro.probe import ProbedRun
    from pop_fast.train.environment import keep_freed_memory

    keep_freed_memory()
    print(f"{job}: {capture.source}; {config.max_steps:,} steps; {chosen}", flush=True)
    said = {"commit": program, **state_of_data(job, config, capture), **({} if base is None else {"base": base})}
    said |= {"untimed": True} if options.untimed else {}
    beside = {BESIDE: json.dumps(said, indent=2) + "\n"}
    more = {"resume": True, "loading_seconds": seconds, "beside": beside}
    ProbedRun(config, capture, every=max(config.log_every, spacing(config.max_steps)), **more).run()


def load_capture_of(job: Job, config: TrainConfig) -> tuple[Capture, float]:
    """Read the photographs and cameras of a job, or what was prepared of them, and say how many seconds that took."""
    from pop_fast.cli.train import arguments, open_capture

    images = [] if job.scene.images is None else ["--images", job.scene.images]
    start = time.perf_counter()
    made = prepared.path_of(Path(config.data), config)
    if made.is_file():
        capture = prepared.read(made, config)
    else:
        capture = open_capture(config, arguments([config.data, *images])[1])
    return capture, time.perf_counter() - start


def _begin(job: Job, options: Options, config: TrainConfig, capture: Capture) -> str | None:
    """Prepare the result folder of a training, and return the run id of what it begins or began from."""
    from paper_repro.collect import BESIDE
    from pop_fast.io.read_back import read_json
    from pop_fast.train.checkpoint import list_checkpoints

    folder = Path(config.result_dir)
    taken = max((step + 1 for step, _ in list_checkpoints(folder)), default=0)
    if 0 < taken < config.max_steps or (taken and not options.again):
        return read_json(folder / BESIDE, "train the row again in an empty folder").get("base")
    # what a finished row has left, whose result was removed since or is to be replaced
    shutil.rmtree(folder, ignore_errors=True)
    return begin_from_base(job, options.results, options.work, config, capture)


def _remove_bulk(job: Job, options: Options) -> None:
    """Remove what a finished row does not need, but for what others begin from."""
    places, work = (options.results, options.work), job.work(options.work)
    if not options.keep_checkpoints:
        keep_for_others(job, *places)
        shutil.rmtree(work / _CHECKPOINTS, ignore_errors=True)
    if not options.keep_ply:
        shutil.rmtree(work / _PLY, ignore_errors=True)
    remove_what_was_kept(job, *places)
