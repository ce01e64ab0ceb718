"""Begin a row where the finished training of another ends: PUP-3DGS prunes a finished 3DGS, which is trained once.

The file of a row names its base. Where that has a result for the same scene, scale and seed, and its last checkpoint is
still there, the row begins from it, at the step and with the bits that it would have come to alone. Otherwise it takes
those steps itself.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro import results
from paper_repro.collect import BESIDE, PROBE
from paper_repro.jobs import Job
from paper_repro.rows import load_row, load_rows

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

__all__ = ["base_of", "begin_from_base", "keep_for_others", "remove_what_was_kept"]

# settings that do nothing before the first round
_OF_ROUNDS: Final = frozenset({"method", "max_steps", "rounds_start_iter", "prune_shares", "score_divisor"})
# what a result is collected from, beside what the checkpoint holds
_RECORDS: Final = ("cfg.json", "metrics.jsonl", BESIDE, PROBE, "stats", "report_data")
# of the result folder of a base: its last checkpoint, until no row needs that any more
_KEPT: Final = "base"


def base_of(job: Job) -> Job | None:
    """Return the training that a job begins from, or None."""
    return None if job.row.base is None else Job(load_row(job.row.base), job.scene, job.scale, job.seed)


def keep_for_others(job: Job, folder: Path, work: Path) -> None:
    """Put a finished job's last checkpoint where it stays, if rows that begin from it have no result yet.

    Args:
        job: that is finished.
        folder: of results.
        work: of checkpoints.
    """
    from pop_fast.train.checkpoint import list_checkpoints

    of_job = job.work(work)
    found = list_checkpoints(of_job)
    if found and _is_awaited(job, folder):
        found[-1][1].replace(_in(of_job / _KEPT) / found[-1][1].name)


def remove_what_was_kept(job: Job, folder: Path, work: Path) -> None:
    """Remove the checkpoint that `keep_for_others` left of a job's base, if this job was the last to need it."""
    base = base_of(job)
    if base is not None and not _is_awaited(base, folder):
        shutil.rmtree(base.work(work) / _KEPT, ignore_errors=True)


def begin_from_base(job: Job, folder: Path, work: Path, config: TrainConfig, capture: Capture) -> str | None:
    """Make a job's result folder from its base's: the records, and the last checkpoint as one of the job's own.

    Args:
        job: whose result folder is not there.
        folder: of results.
        work: of checkpoints.
        config: its settings.
        capture: that it trains on.

    Returns:
        The run id of the base, or None where nothing was made: the job has no base, that is not finished or has no
        checkpoint any more, or was trained with other settings, threads or photographs.

    Raises:
        PopError: the base's result or checkpoint is damaged.
    """
    from pop_fast.train.checkpoint import capture_fingerprint, checkpoint_path, load_checkpoint, save_checkpoint

    base, first = base_of(job), getattr(config.strategy, "rounds_start_iter", 0)
    if base is None or not base.result(folder).is_file():
        return None
    of_base, ours = base.work(work), job.work(work)
    usual = checkpoint_path(of_base, first - 1)
    path = next((path for path in (of_base / _KEPT / usual.name, usual) if path.is_file()), None)
    if path is None:
        return None
    content = load_checkpoint(path)
    if not _fits(content, config) or content["capture"] != capture_fingerprint(capture, config.test_every):
        return None
    # a folder without its checkpoint would be taken for that of a run which has none yet
    made = ours.with_suffix(".begun")
    shutil.rmtree(made, ignore_errors=True)
    for name in _RECORDS:
        copy = shutil.copytree if (of_base / name).is_dir() else shutil.copy2
        copy(of_base / name, _in(made) / name)
    save_checkpoint(checkpoint_path(made, first - 1), {**content, "config": config.binding()})
    made.rename(ours)
    return results.read(base.result(folder)).run


def _is_awaited(job: Job, folder: Path) -> bool:
    others = (Job(row, job.scene, job.scale, job.seed) for row in load_rows() if row.base == job.row.name)
    return any(not other.result(folder).is_file() for other in others)


def _in(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _fits(content: Mapping[str, Any], config: TrainConfig) -> bool:
    """Tell whether a run of other settings has taken the same steps to a checkpoint."""
    import torch

    ours, theirs = _plain(config.binding(), config.method), _plain(content["config"], content["config"]["method"])
    differ = {name for name in {*ours, *theirs} if ours.get(name) != theirs.get(name)}
    return differ <= _OF_ROUNDS and content["threads"] == (config.threads or torch.get_num_threads())


def _plain(settings: Mapping[str, Any], method: str) -> dict[str, Any]:
    """Name the settings of a method without it."""
    return {name.removeprefix(f"{method}."): value for name, value in settings.items()}
