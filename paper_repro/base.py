"""Begin a row where it parts from another: the steps that two rows share are trained once.

PUP-3DGS prunes a finished 3DGS, and both rows of Mini-Splatting are the same until they sample. The file of a row names
its base. Where that has a result for the same scene, scale and seed, and its checkpoint of the step at which they part
is still there, the row begins from it, with the bits that it would have come to alone. Otherwise it takes those steps
itself.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from paper_repro.collect import BESIDE, PROBE
from paper_repro.jobs import Job
from paper_repro.rows import load_row, load_rows

if TYPE_CHECKING:
    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

# the settings in which a row may differ from its base, and for each the setting that says after which step it acts
_ACTS_AFTER: Final = {
    **dict.fromkeys(("method", "max_steps", "prune_shares", "rounds_start_iter", "score_divisor"), "rounds_start_iter"),
    "sampling_factor": "sample_iter",
}
# what a result is collected from, besides what the checkpoint holds
_RECORDS: Final = ("cfg.json", "metrics.jsonl", BESIDE, PROBE, "stats/*", "report_data/opacity_*")
# of the result folder of a base: its checkpoints that rows begin from, until none needs them any more
_KEPT: Final = "base"


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


def begin_from_base(job: Job, folder: Path, work: Path, config: TrainConfig, capture: Capture) -> str | None:
    """Make a job's result folder from its base's: the records, and the checkpoint as one of the job's own.

    Args:
        job: whose result folder is not there.
        folder: of results.
        work: of checkpoints.
        config: its settings.
        capture: that it trains on.

    Returns:
        The run id of the base, or None where nothing was made: the job has no base, that is not finished or does not
        have the checkpoint, or was trained with other settings, threads or photographs.

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
        or content["capture"] != capture_fingerprint(capture, config.test_every)
    ):
        return None
    # a folder without its checkpoint would be taken for that of a run which has none yet
    made = ours.with_suffix(".begun")
    shutil.rmtree(made, ignore_errors=True)
    for record in (found for pattern in _RECORDS for found in of_base.glob(pattern) if _step_of(found) < steps):
        shutil.copy2(record, _ready(made / record.relative_to(of_base)))
    save_checkpoint(checkpoint_path(made, steps - 1), {**content, "config": config.binding()})
    made.rename(ours)
    return result.run


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
