"""Train one row: through what `pop train` itself runs, resumable in the middle, and leave its result as one file.

The steps that two rows share are trained once: PUP-3DGS prunes a finished 3DGS, and both rows of Mini-Splatting are the
same until they sample. The file of a row names its base. Where that has a result for the same scene, scale and seed,
and its checkpoint of the step at which they part is still there, the row begins from it, with the bits that it would
have come to alone. Otherwise it takes those steps itself.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro import prepared, results
from paper_repro.collect import BESIDE, PROBE, collect, first_change, publish, spacing, state_of_data
from paper_repro.jobs import WORK, Job, load_row, load_rows
from paper_repro.results import COMMIT, UNTIMED, Result
from paper_repro.scenes import MADE, PaperScene, find_folder
from pop_fast.errors import PopError
from pop_fast.machine import processor_kind

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

# of a work folder: what finished rows leave to be published
PUBLISHED: Final = "published"
_DEMO_SEED: Final = 0
# of a result folder: what takes space and a finished row does not need
_CHECKPOINTS, _PLY = "ckpts", "ply"
# the settings in which a row may differ from its base, and for each the setting that says after which step it acts
_ACTS_AFTER: Final = {
    **dict.fromkeys(("method", "max_steps", "prune_shares", "rounds_start_iter", "score_divisor"), "rounds_start_iter"),
    "sampling_factor": "sample_iter",
}
# what a result is collected from, besides what the checkpoint holds
_RECORDS: Final = ("cfg.json", "metrics.jsonl", BESIDE, PROBE, "stats/*", "report_data/opacity_*")
# of the result folder of a base: its checkpoints that rows begin from, until none needs them any more
_KEPT: Final = "base"


class BusyError(PopError):
    """Say that another process trains this row.

    Attributes:
        status: the exit status of `pop-repro run`, by which a queue tells it from a failure.
    """

    status: Final = 75


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a row is trained, none of which changes what it is."""

    data: Path  # the folder that holds the scenes
    results: Path = results.RESULTS  # the folder of results
    work: Path = WORK  # the folder of checkpoints; what is in it for a row can be removed once the row is finished
    threads: int = 1  # CPU threads; 0 takes all cores
    backend: str = "auto"  # as `pop train --backend`
    checkpoint_every: int | None = None  # steps that a kill can cost; None takes the scale's
    log_every: int | None = None  # steps between two points of the curve; None takes the scale's
    lpips_vgg: tuple[str, ...] = ()  # weights of LPIPS on VGG16
    lpips_alex: tuple[str, ...] = ()  # weights of LPIPS on AlexNet
    # the folder of what finished rows leave to be published; None takes "published" in the work folder
    published: Path | None = None
    again: bool = False  # train a row that is finished again, and replace its result
    keep_ply: bool = False  # keep the Gaussians in the work folder
    keep_checkpoints: bool = False  # keep the checkpoints too
    untimed: bool = False  # its seconds are not compared, because the machine has other work meanwhile
    quiet: bool = False  # no progress bar


def finished(job: Job, folder: Path) -> Result | None:
    """Return the result of a job; None where it has none.

    Raises:
        PopError: it has one that is damaged, or that was trained with settings that are no longer the row's.
    """
    result = job.result(folder)
    if result is not None:
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
    results.check_writable(job.file(options.results).parent)
    with only_one(work.with_suffix(".lock"), f"{job}: another process trains it"):
        # that process may have finished it meanwhile
        result = None if options.again else job.result(options.results)
        if result is None:
            _train(job, options, config)
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
    try:
        asked = git(here, "rev-parse", "HEAD")
        # results are added while rows are trained, and change nothing
        changed = git(here, "status", "--porcelain", "--untracked-files=no", "--", ":!paper_repro/results")
    except OSError:
        return None
    if asked.returncode != 0 or changed.returncode != 0:
        return None
    return asked.stdout.strip() + ("-dirty" if changed.stdout.strip() else "")


def git(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run git in a folder; the caller looks at the status."""
    return subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)


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
    from paper_repro.data_check import check_capture
    from pop_fast.cli.train import check_backend
    from pop_fast.train.choose import choose_backend

    # asked before the hours of training, in which the clone may move on
    program = commit()
    config, chosen = choose_backend(config, True)
    check_backend(config)
    capture, seconds = load_capture_of(job, config)
    check_capture(job, config, capture)
    was = _begin(job, options, config, capture, program)
    from paper_repro.probe import ProbedRun
    from pop_fast.train.environment import keep_freed_memory

    keep_freed_memory()
    print(f"{job}: {capture.source}; {config.max_steps:,} steps; {chosen}", flush=True)
    said = {"commit": program, **state_of_data(job, config, capture), **was}
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


def _begin(job: Job, options: Options, config: TrainConfig, capture: Capture, program: str | None) -> dict[str, Any]:
    """Prepare the result folder of a training, and return what its result says of the steps that it has already."""
    from pop_fast.io.read_back import read_json
    from pop_fast.train.checkpoint import list_checkpoints

    folder = Path(config.result_dir)
    taken = max((step + 1 for step, _ in list_checkpoints(folder)), default=0)
    if 0 < taken < config.max_steps or (taken and not options.again):
        was = read_json(folder / BESIDE, "train the row again in an empty folder")
        kept, first = {name: was[name] for name in ("base", "begun", "untimed") if name in was}, was.get("commit")
        if taken == config.max_steps:
            return {**kept, "commit": first}
        return {**({} if first in (None, program) else {"begun": first}), **kept}
    # what a finished row has left, whose result was removed since or is to be replaced
    shutil.rmtree(folder, ignore_errors=True)
    base = begin_from_base(job, options.results, options.work, config, capture)
    if base is None:
        return {}
    return {"base": base.run, **({"untimed": True} if base.protocol["timing"].endswith(UNTIMED) else {})}


def _remove_bulk(job: Job, options: Options) -> None:
    """Remove what a finished row does not need, but for what others begin from."""
    places, work = (options.results, options.work), job.work(options.work)
    if not options.keep_checkpoints:
        keep_for_others(job, *places)
        shutil.rmtree(work / _CHECKPOINTS, ignore_errors=True)
    if not options.keep_ply:
        shutil.rmtree(work / _PLY, ignore_errors=True)
    remove_what_was_kept(job, *places)


def base_of(job: Job) -> Job | None:
    """Return the training that a job begins from, or None."""
    return None if job.row.base is None else Job(load_row(job.row.base), job.scene, job.scale, job.seed)


def steps_for_others(job: Job) -> tuple[int, ...]:
    """Return how many steps a job has taken where other rows begin from it, in rising order."""
    return tuple(sorted({_shared_steps(job, other) for other in _followers(job)} - {0}))


def keep_for_others(job: Job, folder: Path, work: Path) -> None:
    """Put those checkpoints of a finished job where they stay that rows without a result begin from.

    Args:
        job: that is finished.
        folder: of results.
        work: of checkpoints.
    """
    from pop_fast.train.checkpoint import checkpoint_path

    of_job = job.work(work)
    for steps in {_shared_steps(job, other) for other in _followers(job) if not other.is_done(folder)}:
        path = checkpoint_path(of_job, steps - 1)
        if path.is_file():
            path.replace(_ready(of_job / _KEPT / path.name))


def remove_what_was_kept(job: Job, folder: Path, work: Path) -> None:
    """Remove what `keep_for_others` left of a job's base, if this job was the last to need it."""
    base = base_of(job)
    if base is not None and all(other.is_done(folder) for other in _followers(base)):
        shutil.rmtree(base.work(work) / _KEPT, ignore_errors=True)


def begin_from_base(job: Job, folder: Path, work: Path, config: TrainConfig, capture: Capture) -> Result | None:
    """Make a job's result folder from its base's: the records, and the checkpoint as one of the job's own.

    Args:
        job: whose result folder is not there.
        folder: of results.
        work: of checkpoints.
        config: its settings.
        capture: that it trains on.

    Returns:
        The base's result, or None where nothing was made: the job has no base, that is not finished or does not have
        the checkpoint, or was trained with other settings, threads or photographs, or on another kind of processor.

    Raises:
        PopError: the base's result or checkpoint is damaged.
    """
    import torch

    from pop_fast.train.checkpoint import capture_fingerprint, checkpoint_path, load_checkpoint, save_checkpoint

    base = base_of(job)
    result = None if base is None else base.result(folder)
    if base is None or result is None:
        return None
    steps, of_base, ours = _shared_steps(base, job), base.work(work), job.work(work)
    usual = checkpoint_path(of_base, steps - 1)
    path = next((path for path in (of_base / _KEPT / usual.name, usual) if path.is_file()), None)
    if path is None:
        return None
    content, config = load_checkpoint(path), config.in_world(capture.world_scale)
    if (
        _shared(content["config"], config.binding()) != steps
        or content["threads"] != (config.threads or torch.get_num_threads())
        or content["capture"] != capture_fingerprint(capture, config)
        # the time of the shared steps is in the row's own; where a GPU trains, the processor matters little
        or (", " not in result.machine and result.cpu != processor_kind())
    ):
        return None
    # a folder without its checkpoint would be taken for that of a run which has none yet
    made = ours.with_suffix(".begun")
    shutil.rmtree(made, ignore_errors=True)
    for record in (found for pattern in _RECORDS for found in of_base.glob(pattern) if _step_of(found) < steps):
        shutil.copy2(record, _ready(made / record.relative_to(of_base)))
    save_checkpoint(checkpoint_path(made, steps - 1), {**content, "config": config.binding()})
    made.rename(ours)
    return result


def _followers(job: Job) -> list[Job]:
    return [Job(row, job.scene, job.scale, job.seed) for row in load_rows() if row.base == job.row.name]


def _shared_steps(job: Job, other: Job) -> int:
    return _shared(job.config().binding(), other.config().binding())


def _shared(first: Mapping[str, Any], second: Mapping[str, Any]) -> int:
    """Return after how many steps settings of two runs first make a difference; 0 where that is not known."""
    one, two = ({name.removeprefix(f"{s['method']}."): value for name, value in s.items()} for s in (first, second))
    differ = {name for name in {*one, *two} if one.get(name) != two.get(name)}
    if not differ or not differ <= _ACTS_AFTER.keys():
        return 0
    both = {**one, **two}
    return min(both.get(_ACTS_AFTER[name], 0) for name in differ)


def _step_of(record: Path) -> int:
    """Return the step that a record is of; 0 for those of the whole run, which are cut where it continues."""
    found = re.search(r"_step(\d+)", record.name)
    return int(found[1]) if found else 0


def _ready(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
