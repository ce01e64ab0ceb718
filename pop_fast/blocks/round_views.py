"""Which photographs a block is trained on in a round: as many as it had, drawn anew from all that show its core.

A block's own views are those that see most of its core. Others show it too, behind or beside what they look at, and
how it looks from there no training has corrected. So each round draws other views among all that show the core, and
holds no more photographs than the block's own training did. The cameras of all views are those of all blocks' lists,
because every training view stands in one core; the capture's own list is not read again.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from pop_fast.blocks.parts import block_folder
from pop_fast.data.block import find_block, read_block, write_block
from pop_fast.data.load import load_capture
from pop_fast.data.random_points import in_picture
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureRecord

__all__ = ["write_round_block"]

# of the Gaussians of a core, what a view must have in its picture to be drawn: fewer are strays
_SHOWN = 0.01


def write_round_block(
    folder: Path, config: TrainConfig, record: CaptureRecord, names: list[str], name: str, number: int, core: np.ndarray
) -> None:
    """Draw the views of a block for a round and write their list, unless that is there already.

    Args:
        folder: the run's.
        config: its settings; the seed is read, and how photographs are.
        record: how the capture is read.
        names: of all blocks.
        name: of this one.
        number: of the round, from 1.
        core: centres of the Gaussians in its core, in the training frame. [N, 3]

    Raises:
        CaptureError: a block's list is damaged.
    """
    place = block_folder(folder, name, number)
    if find_block(place):
        return
    listings = {other: read_block(block_folder(folder, other)) for other in names}
    own = listings[name]
    shots = {shot.name: shot for each in listings.values() for shot in each.shots if shot.split == "train"}
    cameras = load_capture(
        block_folder(folder, name),
        factor=config.factor,
        normalize=config.normalize,
        masks=record.masks,
        missing=record.missing,
        images=record.images,
        resize=config.resize,
        photographs="none",
        listing=replace(own, shots=list(shots.values())),
    )
    points = core.astype(np.float64)
    showing = [view.name for view in cameras.views if in_picture(points, view).mean() >= _SHOWN] if len(core) else []
    had = [shot for shot in own.shots if shot.split == "train"]
    draw = np.random.default_rng([config.seed, number, names.index(name)])
    drawn = draw.permutation(len(showing))[: len(had)]
    chosen = [shots[showing[index]] for index in sorted(drawn)] or had
    write_block(place, replace(own, shots=[*chosen, *(shot for shot in own.shots if shot.split == "test")]))
