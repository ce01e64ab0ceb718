"""How far every decision of a render was from flipping.

A comparison of two computed numbers can only fall the other way in arithmetic of precision eps if their difference is
within a few eps of rounding. So a margin is |operand - threshold| divided by what `magnitudes` says rounding may do to
both, and it is read against eps: with float32's 6e-8, a margin over 1e-6 means that some 16 times the error bound would
be needed to flip the decision. Margins are infinite where both sides are exact, for instance dyadic depths that tie.

Two questions are answered. Which Gaussians, and which pixels, must come out with the same integers from any sound
implementation (`safe_gaussians`, `safe_pixels`)? Which decisions were close (`near_threshold`, `nearest`)? A close D5,
D6 or D7 can be taken the other way by moving the profile's constant by the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.constants import DECISIONS, PAPER, Profile
from pop_ref.extent_margins import ExtentMargins, Rect, extent_margins
from pop_ref.magnitudes import (
    Magnitudes,
    Rounded,
    colors_magnitudes,
    constant,
    depths_magnitudes,
    distance,
    frustum_limits,
    splat_magnitudes,
)
from pop_ref.pixel_margins import PixelMargins, pixel_margins
from pop_ref.records import Camera, Gaussians, Render
from pop_ref.render import render

_HORIZON = 1e-2


class CloseDecision(NamedTuple):
    """One decision and its distance from flipping.

    `where` is (Gaussian,) for D1, D2, D3, B1, B2; (Gaussian, Gaussian) for D4; (x, y, Gaussian) for D5, D6, D7;
    (x, y, winner, rival) for D8.
    """

    decision: str
    where: tuple[int, ...]
    margin: float


@dataclass(frozen=True)
class Margins:
    """Distances of a render's decisions from flipping, relative to what rounding may do, in units of eps.

    Attributes:
        gaussians: D1, D2, D3, D4 and the kinks B1, B2; each the nearest of a Gaussian's decisions of that kind. [N]
        pixels: D1 to D8; each the nearest decision of that kind that can change the pixel. [H, W]
        near: the decisions closer than 0.01, nearest first.
    """

    gaussians: dict[str, Float64[np.ndarray, " N"]]
    pixels: dict[str, Float64[np.ndarray, "H W"]]
    near: tuple[CloseDecision, ...]

    @property
    def nearest(self) -> CloseDecision | None:
        """Give the decision closest to flipping, None if all are farther than 0.01."""
        return self.near[0] if self.near else None

    def near_threshold(self, tolerance: float) -> tuple[CloseDecision, ...]:
        """List the decisions within a tolerance (at most 0.01), nearest first."""
        return tuple(close for close in self.near if close.margin <= tolerance)

    def safe_pixels(self, tolerance: float, decisions: Iterable[str] = tuple(DECISIONS)) -> Bool[np.ndarray, "H W"]:
        """Tell which pixels no decision of these kinds within the tolerance can change.

        All eight guard n_traversed. In opacity-aware profiles D3 cannot change anything else.
        """
        return np.all([self.pixels[decision] > tolerance for decision in decisions], axis=0)

    def safe_gaussians(self, tolerance: float, decisions: Iterable[str] = ("D1", "D2")) -> Bool[np.ndarray, " N"]:
        """Tell whose decisions of these kinds are all beyond the tolerance: D1 and D2 guard visibility and extents."""
        return np.all([self.gaussians[decision] > tolerance for decision in decisions], axis=0)


def margins(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    tile_size: int | None = None,
    antialiased: bool = False,
) -> Margins:
    """Measure how far every decision of `render` with these arguments is from flipping.

    Source: Higham 2002, section 3.3 (running error analysis), applied to D1-D8.
    Departs: nothing.

    Args:
        gaussians: activated, exact in the arithmetic that is to be judged.
        camera: the view.
        sh_degree: as in `render`.
        profile: as in `render`.
        tile_size: as in `render`.
        antialiased: as in `render`.

    Returns:
        The distances.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [1 / 255], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
        >>> margins(g, Camera(np.eye(4), K, 1, 1)).nearest
        CloseDecision(decision='D2', where=(0,), margin=0.0)
    """
    profile = replace(profile, tile_size=profile.tile_size if tile_size is None else tile_size)
    image = render(gaussians, camera, None, sh_degree, profile, None, antialiased)
    book = _Book(len(gaussians), camera.height, camera.width, profile.tile_size)
    depths = depths_magnitudes(gaussians, camera)
    magnitudes: list[Magnitudes | None] = [None] * len(gaussians)
    for i, depth in enumerate(depths):
        if depth.value >= 0.5 * profile.near_plane:
            magnitudes[i] = splat_magnitudes(gaussians, i, camera, profile, antialiased)
        _note_gaussian(book, i, depth, magnitudes[i], camera, profile)
    _note_kinks(book, gaussians, camera, image, magnitudes, sh_degree, profile)
    _note_pixels(book, gaussians, depths, magnitudes, image, profile)
    return Margins(book.gaussians, book.pixels, tuple(sorted(book.near, key=lambda close: close.margin)))


class _Book:
    """The margins as they are found: minima per Gaussian and per pixel, and the list of near ones."""

    def __init__(self, n: int, height: int, width: int, tile_size: int) -> None:
        self.gaussians = {name: np.full(n, math.inf) for name in ("D1", "D2", "D3", "D4", "B1", "B2")}
        self.pixels = {name: np.full((height, width), math.inf) for name in DECISIONS}
        self.near: list[CloseDecision] = []
        self.tile_size = tile_size

    def note(self, decision: str, where: tuple[int, ...], margin: float) -> None:
        if margin <= _HORIZON:
            self.near.append(CloseDecision(decision, where, margin))
        if decision in self.gaussians:
            for i in where:
                self.gaussians[decision][i] = min(self.gaussians[decision][i], margin)
        else:
            self.touch(decision, margin, slice(where[1], where[1] + 1), slice(where[0], where[0] + 1))

    def touch(self, decision: str, margin: float, rows: slice, columns: slice) -> None:
        view = self.pixels[decision][rows, columns]
        np.minimum(view, margin, out=view)

    def touch_tiles(self, decision: str, margin: float, outer: Rect, inner: Rect = (0, 0, 0, 0)) -> None:
        t = self.tile_size
        for y in range(outer[1], outer[3]):
            for x in range(outer[0], outer[2]):
                if not (inner[0] <= x < inner[2] and inner[1] <= y < inner[3]):
                    self.touch(decision, margin, slice(y * t, (y + 1) * t), slice(x * t, (x + 1) * t))


def _note_gaussian(book: _Book, i: int, depth: Rounded, m: Magnitudes | None, camera: Camera, profile: Profile) -> None:
    near, far = constant(profile.near_plane), constant(profile.far_plane)
    beyond_near = depth.value > near.value if profile.near_inclusive else depth.value >= near.value
    before_far = depth.value <= far.value
    in_order = [(beyond_near, distance(depth, near)), (before_far, distance(depth, far))]
    kept = beyond_near and before_far
    margin = min(d for _, d in in_order) if kept else max(d for holds, d in in_order if not holds)
    book.note("D1", (i,), margin)
    if m is None:
        # far behind the near plane a footprint means nothing: a flip could touch every pixel
        book.touch("D1", margin, slice(None), slice(None))
        return
    extent = extent_margins(m, camera.width, camera.height, profile)
    book.touch_tiles("D1", margin, extent.outer)
    if kept:
        _note_extent(book, i, extent)


def _note_extent(book: _Book, i: int, extent: ExtentMargins) -> None:
    book.note("D2", (i,), min(extent.visible, extent.size))
    book.note("D3", (i,), extent.overlap)
    book.touch_tiles("D2", extent.visible, extent.outer)
    book.touch_tiles("D2", extent.size, extent.outer, extent.inner)
    book.touch_tiles("D3", extent.overlap, extent.outer, extent.inner)


def _note_kinks(
    book: _Book,
    gaussians: Gaussians,
    camera: Camera,
    image: Render,
    magnitudes: Sequence[Magnitudes | None],
    sh_degree: int | None,
    profile: Profile,
) -> None:
    centred = profile.principal_point == "centred"
    centers = (camera.width / 2.0, camera.height / 2.0) if centred else (camera.K[0, 2], camera.K[1, 2])
    degree = math.isqrt(gaussians.sh.shape[1]) - 1 if sh_degree is None else sh_degree
    # a Gaussian at the camera's centre has no direction, hence no colour, and is culled
    seen: list[int] = np.flatnonzero(image.splats.visible).tolist()
    sums, errors = colors_magnitudes(gaussians, seen, camera, degree)
    for i, distances in zip(seen, np.abs(sums) / errors, strict=True):
        m = magnitudes[i]
        assert m is not None
        for k, size in enumerate((camera.width, camera.height)):
            focal = Rounded(float(camera.K[k, k]))
            for limit in frustum_limits(focal, Rounded(float(centers[k])), size, profile):
                book.note("B1", (i,), distance(m.ratios[k], limit))
        book.note("B2", (i,), float(np.min(distances)))


def _note_pixels(
    book: _Book,
    gaussians: Gaussians,
    depths: Sequence[Rounded],
    magnitudes: Sequence[Magnitudes | None],
    image: Render,
    profile: Profile,
) -> None:
    height, width = image.T_final.shape
    tiles_x = -(-width // profile.tile_size)
    gaps = [_depth_gaps(ids, gaussians, depths) for ids in image.tile_lists]
    for ids, list_gaps in zip(image.tile_lists, gaps, strict=True):
        for (front, back), gap in zip(pairwise(ids), list_gaps, strict=True):
            book.note("D4", (front, back), gap)
    for y in range(height):
        for x in range(width):
            tile: int = (y // profile.tile_size) * tiles_x + x // profile.tile_size
            # the entry after the terminating one is the last whose order can matter
            order = min(gaps[tile][: int(image.n_traversed[y, x])], default=math.inf)
            book.touch("D4", order, slice(y, y + 1), slice(x, x + 1))
            _note_pixel(book, x, y, pixel_margins(image.tile_lists[tile], magnitudes, x + 0.5, y + 0.5, profile))


def _note_pixel(book: _Book, x: int, y: int, distances: PixelMargins) -> None:
    for decision, found in distances.items():
        for ids, margin in found:
            book.note(decision, (x, y, *ids), margin)


def _depth_gaps(ids: Sequence[int], gaussians: Gaussians, depths: Sequence[Rounded]) -> list[float]:
    gaps: list[float] = []
    for front, back in pairwise(ids):
        # equal centres go through equal arithmetic: their depths tie in any precision, and index order decides
        same = bool(np.all(gaussians.means[front] == gaussians.means[back]))
        gaps.append(math.inf if same else distance(depths[front], depths[back]))
    return gaps
