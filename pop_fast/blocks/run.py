"""The parts of a run in blocks that read the capture: its division at the start, and the merge at the end.

Neither holds all photographs: the division reads none, the merge those that are held out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pop_fast.blocks.map import write_map
from pop_fast.blocks.merge import merge
from pop_fast.blocks.parts import Part, block_folder, result_of
from pop_fast.blocks.plan import FOLDER, Job, Plan, make_plan, write_plan
from pop_fast.data.capture import Capture, Progress
from pop_fast.data.load import Photographs, list_capture, load_capture
from pop_fast.data.posed_images import Listing
from pop_fast.data.sfm_options import SfmOptions
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureRecord
from pop_fast.train.refining import refining

__all__ = ["Division", "config_of", "divide_capture", "merge_capture", "round_config"]


class Division:
    """A capture and how it is divided, in memory until `write`.

    Attributes:
        capture: its cameras and points, without photographs.
        plan: its blocks.
    """

    def __init__(self, capture: Capture, listing: Listing, plan: Plan) -> None:
        self.capture, self.plan, self._listing = capture, plan, listing

    def write(self, folder: Path) -> None:
        """Write blocks, map and plan into a result folder."""
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        write_map(folder / FOLDER / "map.png", self.capture, self.plan)
        write_plan(folder, self.plan, self._listing, self.capture.world_transform)


def divide_capture(
    config: TrainConfig,
    record: CaptureRecord,
    job: Job,
    sfm: bool | SfmOptions = False,
    progress: Progress | None = None,
) -> Division:
    """Read a capture's cameras and points, and divide it.

    Args:
        config: the settings of the run.
        record: how the capture is read.
        job: what was asked for.
        sfm: how the cameras of bare photographs are found.
        progress: is called with (stage, done, total).

    Raises:
        PopError: the capture cannot be read, or not be divided as asked for.
    """
    listing = list_capture(config.data, record.source, record.images, sfm, progress)
    capture = _load(config, record, "none", progress, listing)
    return Division(capture, listing, make_plan(capture, job, config.test_every))


def merge_capture(
    folder: Path, config: TrainConfig, record: CaptureRecord, part: Part, progress: Progress | None = None
) -> tuple[Capture, dict[str, Any]]:
    """Merge the blocks of a round and measure the held-out views of the whole capture; see `merge`.

    Returns:
        The capture, whose held-out photographs alone have been read, and the statistics.
    """
    capture = _load(config, record, "held out", progress)
    return capture, merge(folder, config, capture, part)


def config_of(folder: Path, config: TrainConfig, name: str) -> TrainConfig:
    """Return the settings of a block's training: those of the run, on the block's list and in its folder."""
    return replace(config, data=str(folder / FOLDER / name), result_dir=str(result_of(folder, name)))


def round_config(folder: Path, config: TrainConfig, part: Part, steps: int) -> TrainConfig:
    """Return the settings of a block's training in a round from 1: they continue where those of the run have ended.

    Args:
        folder: the run's.
        config: its settings.
        part: which block, in which round; each round draws another order of views.
        steps: of the round.
    """
    if part.block is None:
        raise ValueError("a merge is no training")
    place = block_folder(folder, part.block, part.round)
    where = {"data": str(place), "result_dir": str(result_of(folder, part.block, part.round))}
    return replace(refining(config, steps), **where, seed=config.seed + part.round)


def _load(
    config: TrainConfig,
    record: CaptureRecord,
    photographs: Photographs,
    progress: Progress | None,
    listing: Listing | None = None,
) -> Capture:
    return load_capture(
        config.data,
        factor=config.factor,
        normalize=config.normalize,
        masks=record.masks,
        missing=record.missing,
        background=config.background,
        progress=progress,
        source=record.source,
        images=record.images,
        resize=config.resize,
        seed=config.seed,
        photographs=photographs,
        test_every=config.test_every,
        listing=listing,
    )
