"""How much brighter each photograph is than the others where they see the same points, whatever its camera noted.

A point that the search for cameras has followed looks the same in all photographs that see it, but for exposure, white
balance and shine. In stops, brightness is e_i + a_j: of photograph i and of point j. Medians over points and over
photographs, in turn, find both; less than half of the points that shine or are hidden do not move them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from pop_fast.data.capture import Capture
from pop_fast.data.normalize import camera_centers

# brightness is a mean over a square of this share of the photograph's longer side, 5 px at least
_PATCH: Final = 0.01
# what photographs do to the light, nearly: a power
GAMMA: Final = 2.2
# stops by which photographs may differ from those taken next to them; what changes slowly, as the automatic exposure
# of a video does, harmonics take up as the colour of a direction: fox drifts by 0.20 stops in this way
UNEVEN: Final = 0.15
# of full brightness: what is darker, and what lacks as much to white, tells nothing of exposure
_DARK: Final = 0.06
# points of a photograph that others see too, under which nothing is said of it
_FEWEST: Final = 20
_ROUNDS: Final = 10
_NEIGHBOURS: Final = 4


def levels_at(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Measure the brightness around places of a photograph.

    Args:
        image: uint8 [H, W, 3 or 4]
        places: px, pixel centres at +0.5. [M, 2]

    Returns:
        Stops, 0 at white; NaN outside the photograph and where it is nearly black or white. float64 [M]
    """
    height, width = image.shape[:2]
    gray = np.ascontiguousarray(image[:, :, :3]).mean(axis=2, dtype=np.float32) / np.float32(255.0)
    side = max(5, int(_PATCH * max(height, width)) | 1)
    gray = cv2.blur(gray, (side, side))
    found = np.full(len(places), np.nan)
    inside = np.isfinite(places).all(axis=1) & ((places >= 0.0) & (places < [width, height])).all(axis=1)
    columns, rows = places[inside].astype(np.int64).T
    values = gray[rows, columns].astype(np.float64)
    telling = (values > _DARK) & (values < 1.0 - _DARK)
    found[np.flatnonzero(inside)[telling]] = GAMMA * np.log2(values[telling])
    return found


@dataclass(frozen=True)
class Exposures:
    """How much brighter each photograph is than the median one.

    Attributes:
        stops: NaN where a photograph shares fewer than 20 points with others. float64 [V]
        errors: standard errors of these, by how far the points scatter. float64 [V]
    """

    stops: np.ndarray
    errors: np.ndarray

    @property
    def drift(self) -> float | None:
        """The standard deviation over the photographs, stops; None where fewer than two have an exposure."""
        return self._beyond_errors(self.stops)

    def unevenness(self, viewmats: np.ndarray) -> float | None:
        """Return the standard deviation of what differs from the median of the four photographs taken nearest.

        Args:
            viewmats: world -> camera, as many. float64 [V, 4, 4]

        Returns:
            Stops; None where fewer than five photographs have an exposure.
        """
        known = np.flatnonzero(np.isfinite(self.stops))
        if len(known) <= _NEIGHBOURS:
            return None
        apart = _apart(viewmats[known])
        nearest = np.argsort(apart, axis=1, kind="stable")[:, :_NEIGHBOURS]
        found = np.full(len(self.stops), np.nan)
        found[known] = self.stops[known] - np.median(self.stops[known][nearest], axis=1)
        return self._beyond_errors(found)

    def _beyond_errors(self, values: np.ndarray) -> float | None:
        known = np.isfinite(values)
        if known.sum() < 2:
            return None
        return float(np.sqrt(max(values[known].var() - np.mean(self.errors[known] ** 2), 0.0)))


def _apart(viewmats: np.ndarray) -> np.ndarray:
    """Return how far cameras are apart: in median distances from their middle, plus the angle in radians. [V, V]"""
    centers, axes = camera_centers(viewmats), viewmats[:, 2, :3]
    scale = np.median(np.linalg.norm(centers - centers.mean(axis=0), axis=1))
    moved = np.linalg.norm(centers[:, None] - centers, axis=2) / max(float(scale), 1e-12)
    apart = moved + np.arccos(np.clip(axes @ axes.T, -1.0, 1.0))
    np.fill_diagonal(apart, np.inf)
    return apart


def exposures(levels: Sequence[np.ndarray], seen: Sequence[np.ndarray]) -> Exposures:
    """Tell how much brighter each photograph is than the median one, by the points that several see.

    Args:
        levels: of each photograph, what `levels_at` gives at the points that it sees. [V] of [M]
        seen: numbers of these points. [V] of int [M]
    """
    values = np.concatenate([*levels, np.zeros(0)])
    photos = np.repeat(np.arange(len(levels)), [len(each) for each in levels])
    points = np.concatenate([*seen, np.zeros(0, np.int64)]).astype(np.int64)
    known = np.isfinite(values)
    values, photos, points = values[known], photos[known], points[known]
    shared = np.bincount(points, minlength=1)[points] > 1
    values, photos = values[shared], photos[shared]
    _, points = np.unique(points[shared], return_inverse=True)
    found, of_points = np.zeros(len(levels)), np.zeros(0)
    for _ in range(_ROUNDS):
        of_points = _medians(values - found[photos], points, int(points.max(initial=-1)) + 1)
        found = _medians(values - of_points[points], photos, len(levels))
    counts = np.bincount(photos, minlength=len(levels))
    scatter = _medians(np.abs(values - found[photos] - of_points[points]), photos, len(levels))
    # of a normal distribution: by the median of distances, and of a median
    errors = 1.4826 * 1.2533 * scatter / np.sqrt(np.maximum(counts, 1))
    found[counts < _FEWEST] = np.nan
    if np.isfinite(found).any():
        found -= np.nanmedian(found)
    return Exposures(found, errors)


def exposures_of(capture: Capture) -> Exposures:
    """Return the exposures of the photographs that the tracks of the points tell of, in the order of the views."""
    views = capture.views
    nothing = np.zeros(0, np.int64)
    seen = [nothing if view.seen is None or not view.was_read else view.seen for view in views]
    levels = []
    for view, rows in zip(views, seen, strict=True):
        points = capture.points[rows] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        depths = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        levels.append(levels_at(view.image, (points @ view.K.T)[:, :2] / depths[:, None]) if len(rows) else np.zeros(0))
    return exposures(levels, seen)


def _medians(values: np.ndarray, groups: np.ndarray, n: int) -> np.ndarray:
    """Return the median of every group; 0 of an empty one. [n]"""
    order = np.lexsort((values, groups))
    counts = np.bincount(groups, minlength=n)
    first = np.cumsum(counts) - counts
    ordered = np.append(values[order], 0.0)
    low, high = ordered[first + np.maximum(counts - 1, 0) // 2], ordered[np.minimum(first + counts // 2, len(values))]
    return np.where(counts > 0, (low + high) / 2.0, 0.0)
