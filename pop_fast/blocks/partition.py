"""Divide the ground of a capture into K x L cores that hold equally many cameras.

The ground is spanned by the two directions in which the cameras are spread most: the first two principal axes of their
centres, which are horizontal where a street is driven, a field is flown over or an object is walked around, and need no
word for what is up. The first axis is cut into K strips of equally many cameras, and each strip along the second axis
into L cores. The outer cores have no outer border, so that every point of the world lies in the core of one block and
in no other: what lies on a border belongs to the core of larger coordinates.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pop_fast.errors import PopError

__all__ = ["Partition", "divide", "grid_of"]

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
    """K x L cores; block number i L + j is core j of strip i.

    Attributes:
        origin: where the coordinates on the ground are (0, 0): the mean of the camera centres. float64 [3]
        axes: the two directions of the ground, orthonormal. float64 [2, 3]
        strips: borders between the strips, ascending. float64 [K - 1]
        cores: of each strip, the borders between its cores, ascending. float64 [K, L - 1]
        low, high: the cameras' range on either axis, which is where a core without an outer border is taken to end
            when its size is asked for. float64 [2]
    """

    origin: np.ndarray
    axes: np.ndarray
    strips: np.ndarray
    cores: np.ndarray
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
            block: its number.
            margin: the share, 0 for the core itself.

        Returns:
            Lower and upper border on either axis. float64 [2 axes, 2]
        """
        i, j = divmod(block, self.grid[1])
        open_box = np.array(
            [
                _between(self.strips, i),
                _between(self.cores[i], j),
            ]
        )
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

    A border lies in the middle between the two cameras that it separates.

    Args:
        centers: of the training cameras. [V, 3]
        grid: K and L.

    Raises:
        PopError: there are fewer cameras than blocks, or so many at one place that a block gets none.
    """
    centers = np.asarray(centers, np.float64)
    k, l = grid
    if len(centers) < k * l:
        raise PopError(f"--blocks {k}x{l} needs {k * l} training views or more, and there are {len(centers)}")
    origin = centers.mean(axis=0)
    axes = _principal(centers - origin)
    ground = (centers - origin) @ axes.T
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


def _principal(offsets: np.ndarray) -> np.ndarray:
    """Return the two directions of greatest spread, each with its largest entry positive. float64 [2, 3]"""
    _, axes = np.linalg.eigh(offsets.T @ offsets)
    chosen = axes.T[::-1][:2].copy()
    for row in chosen:
        if row[np.argmax(np.abs(row))] < 0.0:
            row *= -1.0
    return chosen


def _borders(values: np.ndarray, parts: int) -> np.ndarray:
    """Return the borders of equally full parts of the line. float64 [parts - 1]"""
    ordered = np.sort(values)
    first = [round(len(ordered) * part / parts) for part in range(1, parts)]
    return np.array([0.5 * (ordered[at - 1] + ordered[at]) for at in first], np.float64)


def _between(borders: Sequence[float] | np.ndarray, index: int) -> tuple[float, float]:
    low = -np.inf if index == 0 else float(borders[index - 1])
    high = np.inf if index == len(borders) else float(borders[index])
    return low, high
