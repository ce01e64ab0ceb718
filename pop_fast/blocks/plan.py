"""Divide the ground of a capture into K x L cores that hold equally many cameras, and decide what each is trained on.

The ground is spanned by the two directions in which the cameras are spread most: the first two principal axes of their
centres. These are horizontal for a drive along a street, a flight over a field or a walk around an object, and do not
need a known up direction. The first axis is cut into K strips of equally many cameras, and each strip along the second
axis into L cores. The outer cores have no outer border, so that every point of the world is in the core of one block
and in no other: a point on a border belongs to the core of larger coordinates.

A block's Gaussians are those of its core. To train them it gets

-   the training views that stand in the core or within its margin, and those that stand elsewhere and see enough of
    it: the core holds at least the share `share` of the sparse points in their picture. So a border is seen from
    both sides, and views from afar train the core too.
-   the sparse points of the core and its margin, and an even selection of the outside points in its views, at most as
    many again. Without those, Gaussians of the core would have to explain what is behind it;
    with all of them, a block would be no smaller than the whole. What grows there is dropped when blocks are merged.

Whether a view sees a point is judged by the edges of its picture alone; occlusion is ignored. Each held-out view
belongs to the block whose core it stands in, and the whole is measured on all.

The folder of a run in blocks has a result's own files, which describe the merged splat, and:

    blocks/job.json         what was asked for
    blocks/plan.json        borders, and the numbers of every block
    blocks/map.png          the same seen from above
    blocks/i_j/             one block: the list of its photographs and its points (see `pop_fast.data.load`)
    blocks/i_j/result/      its training, an ordinary result folder
    blocks/i_j/trained      is there when its training is finished
    blocks/coarse/          where blocks begin from a coarse model of the whole: its list, training and marker, likewise
    blocks/merged           is there when the blocks are merged for the last time

and of every round r, from 0, that another one follows:

    blocks/round_r/i_j.pt      the merged Gaussians of a core, which the next round starts from
    blocks/round_r/stats.json  what they measure
    blocks/round_r/merged      is there when these are

and of every round from 1 (see `pop_fast.blocks.rounds`):

    blocks/round_r/i_j/block.json  the views that the block drew (with points.npz, as above)
    blocks/round_r/i_j/start.json  how many Gaussians the block trained, and how many it held fixed
    blocks/round_r/i_j/result/     its training: the first rows are those that it trained
    blocks/round_r/i_j/trained     is there when that is finished
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.data.capture import Capture, Listing, SparsePoints, principal_axes
from pop_fast.data.load import in_picture, write_block
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_json
from pop_fast.io.read_back import read_json

FOLDER: Final = "blocks"
JOB: Final = f"{FOLDER}/job.json"
_PLAN = "plan.json"
# what a run in blocks that begins from a coarse model trains first; no block's name, which is "i_j"
COARSE: Final = "coarse"
# photographs shrunk by more show little
_MOST_COARSE: Final = 16
_FIX: Final = "start 'pop train --blocks' again with --overwrite"
# rounds of a run if the number is not given: of bonsai's 2.6 dB between merged and whole the first, the second and the
# third give back 1.5, 0.5 and 0.3; and the steps of one as a share of a block's training
DEFAULT_ROUNDS: Final = 2
ROUND_SHARE: Final = 0.1
_WHOLE: Final = ("rounds", "round_steps", "coarse")
# more parts than a workflow shows, and surely a slip
_MOST_ROUNDS: Final = 100


@dataclass(frozen=True, kw_only=True)
class Job:
    """What was asked for."""

    blocks: str  # the grid, as "2x2"
    margin: float = 0.2  # what a block is trained on beyond its core, as a share of the core's size on either axis
    # of the sparse points in a view's picture, those in a core must be so many for the view to train it
    share: float = 0.25
    rounds: int = 0  # how often the merged Gaussians are trained on, every block those of its core
    round_steps: int = 0  # of a block in each round; 0 where there is none
    # blocks begin from a model of the whole, whose photographs are shrunk by this; 0 trains each block by itself
    coarse: int = 0
    # what is written when the blocks are merged, as `FinishOptions` has it
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

        if self.coarse and not 2 <= self.coarse <= _MOST_COARSE:
            raise PopError(f"--blocks-coarse is {self.coarse}; it must be from 2 to {_MOST_COARSE}, or 0 for none")
        if self.coarse and self.rounds == 0:
            raise PopError("--blocks-coarse needs rounds, in which blocks are trained; add --blocks-rounds 2")

    @property
    def trained_first(self) -> list[str]:
        """Return the names of what is trained before the first merge: the blocks, or the coarse model."""
        return [COARSE] if self.coarse else self.names

    @property
    def names(self) -> list[str]:
        """Return the blocks' names."""
        k, l = grid_of(self.blocks)
        return [f"{i}_{j}" for i in range(k) for j in range(l)]


@dataclass(frozen=True, eq=False)
class Block:
    """What one block is trained on."""

    name: str  # "i_j", of strip and core
    views: frozenset[str]  # names of its training views
    own_views: int  # how many of them stand in its core; those of all blocks are all training views
    held_out: frozenset[str]  # names of the held-out views that stand in its core
    points: np.ndarray  # indices of the sparse points in its core and margin, then of those outside. int64 [P]
    background: int  # how many of the points are outside


@dataclass(frozen=True, eq=False)
class Plan:
    """How a capture is divided."""

    job: Job  # what was asked for
    partition: Partition  # the cores, in the frame that is trained in
    blocks: tuple[Block, ...]  # what each is trained on


def make_plan(capture: Capture, job: Job, test_every: int) -> Plan:
    """Divide a capture.

    Args:
        capture: its cameras and points; photographs need not have been read.
        test_every: which views are held out; see `Capture.test_views`.

    Raises:
        PopError: there are no sparse points, or a block has no training view, no second view or no point.
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
        if len(views[number]) + len(names) < 2:
            raise PopError(
                f"{capture.name}: block {name} of --blocks {job.blocks} has one view alone, and a training needs two; "
                "ask for fewer blocks, a wider --blocks-margin or a smaller --blocks-share"
            )
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
    """Read what was asked for, None where a folder is no run in blocks; PopError where job.json is damaged."""
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
    """Write every block's list and points, then the plan, which says that they are complete; `transform` is [4, 4]."""
    cloud = listing.cloud
    if cloud is None:
        raise ValueError("a capture without points cannot be divided")
    for block in plan.blocks:
        shots = [replace(shot, split="train") for shot in listing.shots if shot.name in block.views]
        shots += [replace(shot, split="test") for shot in listing.shots if shot.name in block.held_out]
        points = SparsePoints(cloud.xyz[block.points], cloud.rgb[block.points])
        write_block(folder / FOLDER / block.name, replace(listing, shots=shots, cloud=points, transform=transform))
    if plan.job.coarse:
        held = {name for block in plan.blocks for name in block.held_out}
        shots = [replace(shot, split="test" if shot.name in held else "train") for shot in listing.shots]
        write_block(folder / FOLDER / COARSE, replace(listing, shots=shots, transform=transform))
    content = {"blocks": [entry_of(block) for block in plan.blocks], "partition": plan.partition.plain()}
    write_json(folder / FOLDER / _PLAN, content)


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
    """Read the borders and every block's numbers, None where nothing is divided yet; PopError where that is damaged."""
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


# more jobs than a workflow shows, and surely a slip
_MOST = 64
_PATTERN = re.compile(r"([1-9]\d*)[xX×]([1-9]\d*)")


def grid_of(text: str) -> tuple[int, int]:
    """Read "KxL": how many strips along the axis of greatest spread, and how many cores in each.

    Raises:
        PopError: it is something else, or asks for one block or for too many.
    """
    match = _PATTERN.fullmatch(text.strip())
    if match is None:
        raise PopError(f"--blocks is {text!r}; it must be two whole numbers with an x between them, as in 2x2 or 3x1")
    k, l = (int(number) if len(number) < 6 else 10**6 for number in match.groups())
    if k * l == 1:
        raise PopError("--blocks 1x1 is the whole capture; leave it out, or ask for more blocks, as in 2x2")
    if max(k, l) > _MOST:
        raise PopError(f"--blocks is {text!r}; each number must be at most {_MOST}")
    return k, l


@dataclass(frozen=True, eq=False)
class Partition:
    """K x L cores; block number i L + j is core j of strip i."""

    # where the coordinates on the ground are (0, 0): the mean of the camera centres. float64 [3]
    origin: np.ndarray
    axes: np.ndarray  # the two directions of the ground, orthonormal. float64 [2, 3]
    strips: np.ndarray  # borders between the strips, ascending. float64 [K - 1]
    cores: np.ndarray  # of each strip, the borders between its cores, ascending. float64 [K, L - 1]
    # low, high: the cameras' range on either axis, which is where a core without an outer border is taken to end when
    # its size is asked for. float64 [2]
    low: np.ndarray
    high: np.ndarray

    @property
    def grid(self) -> tuple[int, int]:
        """K and L."""
        return len(self.strips) + 1, self.cores.shape[1] + 1

    @property
    def names(self) -> list[str]:
        """Return the blocks' names, "i_j" of strip and core, in the order of their numbers."""
        k, l = self.grid
        return [f"{i}_{j}" for i in range(k) for j in range(l)]

    def on_ground(self, points: np.ndarray) -> np.ndarray:
        """Return the coordinates of points [P, 3] on the ground. float64 [P, 2]"""
        return (np.asarray(points, np.float64) - self.origin) @ self.axes.T

    def block_of(self, points: np.ndarray) -> np.ndarray:
        """Return the number of the one block whose core holds each point [P, 3]. int64 [P]"""
        u, v = self.on_ground(points).T
        strip = np.searchsorted(self.strips, u, side="right")
        # how many of its strip's borders a point is not below
        core = (self.cores[strip] <= v[:, None]).sum(axis=1)
        return strip * self.grid[1] + core

    def box(self, block: int, margin: float = 0.0) -> np.ndarray:
        """Return the borders of a block's core, moved out by a share of its size; infinite where it has none.

        Args:
            margin: the share, 0 for the core itself.

        Returns:
            Lower and upper border on either axis. float64 [2 axes, 2]
        """
        i, j = divmod(block, self.grid[1])
        open_box = np.array([_between(self.strips, i), _between(self.cores[i], j)])
        ends = np.stack([self.low, self.high], axis=1)
        closed = np.where(np.isfinite(open_box), open_box, ends)
        size = np.maximum(closed[:, 1] - closed[:, 0], 0.0)
        return open_box + margin * size[:, None] * np.array([-1.0, 1.0])

    def inside(self, block: int, points: np.ndarray, margin: float) -> np.ndarray:
        """Tell which points [P, 3] lie in a block's core or within its margin. bool [P]"""
        ground, box = self.on_ground(points), self.box(block, margin)
        within = np.all((ground >= box[:, 0]) & (ground < box[:, 1]), axis=1)
        # the core itself by the one rule that decides it, however the borders are rounded
        return within | (self.block_of(points) == block)

    def plain(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        fields = ("origin", "axes", "strips", "cores", "low", "high")
        return {name: getattr(self, name).tolist() for name in fields}

    @classmethod
    def of(cls, plain: dict[str, Any]) -> Partition:
        """Take back what `plain` gave.

        Raises:
            ValueError, KeyError, TypeError, OverflowError: it is something else.
        """
        arrays = {name: np.array(plain[name], np.float64) for name in ("origin", "axes", "strips", "low", "high")}
        cores = np.array(plain["cores"], np.float64).reshape(len(plain["cores"]), -1)
        shapes = {"origin": (3,), "axes": (2, 3), "strips": (len(cores) - 1,), "low": (2,), "high": (2,)}
        for name, shape in shapes.items():
            if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                raise ValueError(f"{name} has shape {list(arrays[name].shape)}, or entries that are not finite")
        return cls(**arrays, cores=cores)


def divide(centers: np.ndarray, grid: tuple[int, int]) -> Partition:
    """Divide the ground so that every core holds the same number of cameras, give or take one for each cut.

    A border is in the middle between the two cameras that it separates.

    Args:
        centers: of the training cameras. [V, 3]

    Raises:
        PopError: there are fewer cameras than blocks, or so many at one place that a block gets none.
    """
    centers = np.asarray(centers, np.float64)
    k, l = grid
    if len(centers) < k * l:
        raise PopError(f"--blocks {k}x{l} needs {k * l} training views or more, and there are {len(centers)}")
    origin = centers.mean(axis=0)
    offsets = centers - origin
    axes = principal_axes(offsets.T @ offsets)[:2]
    ground = offsets @ axes.T
    strips = _borders(ground[:, 0], k)
    strip = np.searchsorted(strips, ground[:, 0], side="right")
    short = np.flatnonzero(np.bincount(strip, minlength=k) < l)
    if len(short) == 0:
        cores = np.array([_borders(ground[strip == i, 1], l) for i in range(k)]).reshape(k, l - 1)
        found = Partition(origin, axes, strips, cores, ground.min(axis=0), ground.max(axis=0))
        count = np.bincount(found.block_of(centers), minlength=k * l)
        if count.all():
            return found
        empty = found.names[int(np.argmin(count))]
    else:
        empty = f"{short[0]}_0"
    raise PopError(
        f"--blocks {k}x{l}: block {empty} has no training view, because too many cameras stand at one place on the "
        "ground; ask for fewer blocks, or for other numbers of strips and cores"
    )


def _borders(values: np.ndarray, parts: int) -> np.ndarray:
    """Return the borders of equally full parts of the line. float64 [parts - 1]"""
    ordered = np.sort(values)
    first = [round(len(ordered) * part / parts) for part in range(1, parts)]
    return np.array([0.5 * (ordered[at - 1] + ordered[at]) for at in first], np.float64)


def _between(borders: Sequence[float] | np.ndarray, index: int) -> tuple[float, float]:
    low = -np.inf if index == 0 else float(borders[index - 1])
    high = np.inf if index == len(borders) else float(borders[index])
    return low, high
