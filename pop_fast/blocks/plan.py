"""Decide which photographs and points each block of a capture is trained on, and write that down.

A block's Gaussians are those of its core. To train them it gets

-   the training views that stand in the core or within its margin, and those that stand elsewhere and see enough of
    it: the core holds at least the share `share` of the sparse points in their picture. A border is so seen from both
    sides, and a core that is looked at from afar is trained by the blocks that look at it.
-   the sparse points of the core and its margin, and of the points outside that its views have in their pictures an
    even selection, at most as many. Without those, Gaussians of the core would have to explain what lies behind it;
    with all of them, a block would be no smaller than the whole. What grows there is dropped when blocks are merged.

What a view sees is judged by its picture's edges alone: the sparse points stand for surfaces, and what hides them is
not looked for. Each held-out view belongs to the block whose core it stands in, and the whole is measured on all.

The folder of a run in blocks has a result's own files, which describe the merged splat, and:

    blocks/job.json         what was asked for
    blocks/plan.json        borders, and the numbers of every block
    blocks/map.png          the same seen from above
    blocks/i_j/             one block: the list of its photographs and its points (see `pop_fast.data.load`)
    blocks/i_j/result/      its training, an ordinary result folder
    blocks/i_j/trained      is there when its training is finished
    blocks/merged           is there when the blocks are merged for the last time

and of every round r, from 0, that another one follows:

    blocks/round_r/i_j.pt      the merged Gaussians of a core, which the next round starts from
    blocks/round_r/stats.json  what they measure
    blocks/round_r/merged      is there when these are

and of every round from 1 (see `pop_fast.blocks.rounds` and `pop_fast.blocks.rounds`):

    blocks/round_r/i_j/block.json  the views that the block drew (with points.npz, as above)
    blocks/round_r/i_j/start.json  how many Gaussians the block trained, and how many it held fixed
    blocks/round_r/i_j/result/     its training: the first rows are those that it trained
    blocks/round_r/i_j/trained     is there when that is finished
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.blocks.partition import Partition, divide, grid_of
from pop_fast.data.capture import Capture, Listing, SparsePoints
from pop_fast.data.load import in_picture, write_block
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.io.read_back import read_json

__all__ = [
    "DEFAULT_ROUNDS",
    "FOLDER",
    "JOB",
    "ROUND_SHARE",
    "Block",
    "Job",
    "Plan",
    "job_text",
    "make_plan",
    "read_job",
    "read_plan",
    "write_plan",
]

FOLDER: Final = "blocks"
JOB: Final = f"{FOLDER}/job.json"
_PLAN = "plan.json"
_FIX: Final = "start 'pop train --blocks' again with --overwrite"
# rounds of a run where nobody says how many: of bonsai's 2.6 dB between merged and whole the first, the second and the
# third give back 1.5, 0.5 and 0.3; and the steps of one as a share of a block's training
DEFAULT_ROUNDS: Final = 2
ROUND_SHARE: Final = 0.1
_WHOLE: Final = ("rounds", "round_steps")
# more parts than a workflow shows, and surely a slip
_MOST_ROUNDS: Final = 100


@dataclass(frozen=True, kw_only=True)
class Job:
    """What was asked for.

    Attributes:
        blocks: the grid, as "2x2".
        margin: what a block is trained on beyond its core, as a share of the core's size on either axis.
        share: of the sparse points in a view's picture, those in a core must be so many for the view to train it.
        rounds: how often the merged Gaussians are trained on, every block those of its core.
        round_steps: of a block in each round; 0 where there is none.
        finish: what is written when the blocks are merged, as `FinishOptions` has it.
    """

    blocks: str
    margin: float = 0.2
    share: float = 0.25
    rounds: int = 0
    round_steps: int = 0
    finish: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        grid_of(self.blocks)
        if not 0.0 <= self.margin <= 1.0:
            raise PopError(f"--blocks-margin is {self.margin}; it must be between 0 and 1, a share of a block's size")
        if not 0.0 < self.share <= 1.0:
            raise PopError(
                f"--blocks-share is {self.share}; it must be over 0 and at most 1, a share of a view's points"
            )
        if not 0 <= self.rounds <= _MOST_ROUNDS:
            raise PopError(f"--blocks-rounds is {self.rounds}; it must be from 0 to {_MOST_ROUNDS}")
        if self.rounds > 0 and self.round_steps < 1:
            raise PopError(f"--blocks-round-steps is {self.round_steps}; it must be 1 or more")

    @property
    def names(self) -> list[str]:
        """Return the blocks' names."""
        k, l = grid_of(self.blocks)
        return [f"{i}_{j}" for i in range(k) for j in range(l)]


@dataclass(frozen=True, eq=False)
class Block:
    """What one block is trained on.

    Attributes:
        name: "i_j", of strip and core.
        views: names of its training views.
        own_views: how many of them stand in its core; those of all blocks are all training views.
        held_out: names of the held-out views that stand in its core.
        points: indices of the sparse points in its core and margin, then of those outside. int64 [P]
        background: how many of the points are outside.
    """

    name: str
    views: frozenset[str]
    own_views: int
    held_out: frozenset[str]
    points: np.ndarray
    background: int


@dataclass(frozen=True, eq=False)
class Plan:
    """How a capture is divided.

    Attributes:
        job: what was asked for.
        partition: the cores, in the frame that is trained in.
        blocks: what each is trained on.
    """

    job: Job
    partition: Partition
    blocks: tuple[Block, ...]


def make_plan(capture: Capture, job: Job, test_every: int) -> Plan:
    """Divide a capture.

    Args:
        capture: its cameras and points; photographs need not have been read.
        job: what is asked for.
        test_every: which views are held out; see `Capture.test_views`.

    Raises:
        PopError: there are no sparse points, or a block has no training view or no point.
    """
    if len(capture.points) == 0:
        raise PopError(
            f"{capture.name}: has no sparse points, by which --blocks decides which view sees which block; bring them "
            "with the capture, or find cameras and points with pop sfm"
        )
    train, test = capture.train_views(test_every), capture.test_views(test_every)
    centers = np.array([view.camera_center for view in train]).reshape(-1, 3)
    partition = divide(centers, grid_of(job.blocks))
    count = len(partition.names)
    core = partition.block_of(capture.points)
    own = np.stack([partition.inside(block, capture.points, job.margin) for block in range(count)])
    near = np.stack([partition.inside(block, centers, job.margin) for block in range(count)])
    seen_by = np.zeros_like(own)
    views: list[set[str]] = [set() for _ in range(count)]
    for index, view in enumerate(train):
        seen = in_picture(capture.points, view)
        shares = np.bincount(core[seen], minlength=count) / max(np.count_nonzero(seen), 1)
        for block in np.flatnonzero(near[:, index] | (shares >= job.share)):
            views[block].add(view.name)
            seen_by[block] |= seen
    places = partition.block_of(np.array([view.camera_center for view in test]).reshape(-1, 3))
    stands = partition.block_of(centers)
    blocks = []
    for number, name in enumerate(partition.names):
        inside = np.flatnonzero(own[number])
        if len(inside) == 0:
            raise PopError(
                f"{capture.name}: block {name} of --blocks {job.blocks} has no sparse point within its margin of "
                f"{job.margin}; ask for fewer blocks or a wider --blocks-margin"
            )
        outside = _evenly(np.flatnonzero(seen_by[number] & ~own[number]), len(inside))
        names = frozenset(view.name for view, place in zip(test, places, strict=True) if place == number)
        points = np.concatenate([inside, outside])
        here = int(np.count_nonzero(stands == number))
        blocks.append(Block(name, frozenset(views[number]), here, names, points, len(outside)))
    return Plan(job, partition, tuple(blocks))


def _evenly(indices: np.ndarray, most: int) -> np.ndarray:
    """Select at most so many, evenly over their order."""
    if len(indices) <= most:
        return indices
    return indices[np.linspace(0, len(indices) - 1, most).round().astype(np.int64)]


def job_text(job: Job) -> str:
    """Return what job.json holds."""
    return json.dumps(asdict(job), indent=2) + "\n"


def read_job(folder: Path) -> Job | None:
    """Read what was asked for, or None where a folder is no run in blocks.

    Raises:
        PopError: job.json is damaged.
    """
    path = folder / JOB
    if not path.is_file():
        return None
    content = read_json(path, _FIX)
    try:
        if type(content.get("blocks")) is not str or any(type(content.get(k, 0)) is not int for k in _WHOLE):
            raise TypeError(f"blocks must be a text, {' and '.join(_WHOLE)} whole numbers")
        return Job(**content)
    except (TypeError, PopError) as error:
        raise PopError(f"{path}: is not what 'pop train --blocks' writes ({error}); {_FIX}") from error


def write_plan(folder: Path, plan: Plan, listing: Listing, transform: np.ndarray) -> None:
    """Write every block's list and points, and then the plan, which says that they are complete.

    Args:
        folder: the result folder.
        plan: of the capture.
        listing: the capture's own, in its own frame.
        transform: the capture's training frame. float64 [4, 4]
    """
    cloud = listing.cloud
    if cloud is None:
        raise ValueError("a capture without points cannot be divided")
    for block in plan.blocks:
        shots = [replace(shot, split="train") for shot in listing.shots if shot.name in block.views]
        shots += [replace(shot, split="test") for shot in listing.shots if shot.name in block.held_out]
        points = SparsePoints(cloud.xyz[block.points], cloud.rgb[block.points])
        write_block(folder / FOLDER / block.name, replace(listing, shots=shots, cloud=points, transform=transform))
    _write_json(
        folder / FOLDER / _PLAN,
        {
            "blocks": [entry_of(block) for block in plan.blocks],
            "partition": plan.partition.plain(),
        },
    )


def entry_of(block: Block) -> dict[str, Any]:
    """Return the numbers of a block, as plan.json has them."""
    return {
        "name": block.name,
        "training_views": len(block.views),
        "in_its_core": block.own_views,
        "held_out_views": len(block.held_out),
        "points": len(block.points) - block.background,
        "background_points": block.background,
    }


def read_plan(folder: Path) -> tuple[Partition, list[dict[str, Any]]] | None:
    """Read the borders and every block's numbers, or None where the capture is not divided yet.

    Raises:
        PopError: plan.json is damaged.
    """
    path = folder / FOLDER / _PLAN
    if not path.is_file():
        return None
    content = read_json(path, _FIX)
    try:
        partition = Partition.of(content["partition"])
        entries: Sequence[dict[str, Any]] = content["blocks"]
        if [entry["name"] for entry in entries] != partition.names:
            raise ValueError("its blocks are not those of its borders")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise PopError(f"{path}: is not what 'pop train --blocks' writes ({error!r}); {_FIX}") from error
    return partition, list(entries)


def _write_json(path: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))
