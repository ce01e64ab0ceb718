"""How far every decision of a render was from flipping.

A comparison of two computed numbers can only fall the other way in arithmetic of precision eps if their difference is
within a few eps of rounding. So a margin is |operand - threshold| divided by what `magnitudes` says rounding may do to
both, and it is read against eps: with float32's 6e-8, a margin over 1e-6 means that some 16 times the error bound would
be needed to flip the decision. Margins are infinite where both sides are exact, for instance dyadic depths that tie.

Two questions are answered. Which Gaussians, and which pixels, must come out with the same integers from any sound
implementation (`safe_gaussians`, `safe_pixels`)? Which decisions were close (`near_threshold`, `nearest`)? A close D5,
D6 or D7 can be taken the other way by moving the profile's constant by the tolerance.

`extent_margins` has the decisions of one Gaussian's extent: cull and size (D2), tile rectangle (D3). `pixel_margins`
has those of one pixel: floor (D5), ceiling (D6), stop (D7), dominance (D8); it carries the errors of `magnitudes` on
through exponent, alpha and transmittance, as plain floats because it is the innermost loop.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.alpha import falloff, sigma_at_pixel
from pop_ref.camera import NEAREST
from pop_ref.constants import DECISIONS, PAPER, Profile
from pop_ref.magnitudes import (
    Magnitudes,
    Rounded,
    colors_magnitudes,
    constant,
    depths_magnitudes,
    distance,
    frustum_limits,
    in_float32,
    splat_magnitudes,
)
from pop_ref.pixel import stops
from pop_ref.records import Camera, Gaussians, Render
from pop_ref.render import render
from pop_ref.tiles import grid_size, tile_span

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
        if depth.value >= 0.5 * profile.near_plane and depth.value > NEAREST:
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
    in_order = [(beyond_near and depth.value > NEAREST, distance(depth, near)), (before_far, distance(depth, far))]
    kept = all(holds for holds, _ in in_order)
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


PixelMargins = dict[str, list[tuple[tuple[int, ...], float]]]


def pixel_margins(
    ids: Sequence[int], magnitudes: Sequence[Magnitudes | None], px: float, py: float, profile: Profile
) -> PixelMargins:
    """Measure D5 to D8 at one pixel, over the list entries visited until it stops.

    Source: Higham 2002, section 3.3, applied to `pixel.composite_pixel`.
    Departs: nothing.

    Args:
        ids: the tile's list, front to back.
        magnitudes: of every Gaussian; those in the list are not None.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.
        profile: floor, ceiling and stop.

    Returns:
        For each decision the splats it is about and its distance in units of eps: D5, D6, D7 of each entry that gets
        that far, D8 of the winner against each rival.

    Example:
        >>> from pop_ref.constants import PAPER
        >>> one, half = Rounded(1.0), Rounded(0.5)
        >>> m = Magnitudes(one, (half, half), (one, one), (one, Rounded(0.0), one), one, (one, Rounded(0.0), one), half)
        >>> found = pixel_margins([0, 1], [m, m], 0.5, 0.5, PAPER)
        >>> found["D8"]
        [((0, 1), inf)]
    """
    floor, ceiling = constant(profile.alpha_floor), constant(profile.alpha_ceiling)
    stop = constant(profile.transmittance_stop)
    found: PixelMargins = {"D5": [], "D6": [], "D7": [], "D8": []}
    left = Rounded(1.0)
    weights: list[tuple[int, Rounded]] = []
    for i in ids:
        m = magnitudes[i]
        assert m is not None
        sigma = _sigma(m, px, py)
        if sigma.value < 0.0:
            found["D5"].append(((i,), distance(sigma, Rounded(0.0))))
            continue
        raw = _raw_alpha(sigma, m.opacity)
        found["D5"].append(((i,), distance(raw, floor)))
        if raw.value < floor.value:
            continue
        # sigma < 0 is only possible if rounding makes the conic indefinite
        definite = m.conic[0] * m.conic[2] - m.conic[1] * m.conic[1]
        sign = max(distance(sigma, Rounded(0.0)), distance(definite, Rounded(0.0)))
        found["D5"].append(((i,), sign))
        found["D6"].append(((i,), distance(raw, ceiling)))
        alpha = raw if raw.value <= ceiling.value else ceiling
        next_left = left * (Rounded(1.0) - alpha)
        found["D7"].append(((i,), distance(next_left, stop)))
        if stops(next_left.value, profile):
            break
        weights.append((i, left * alpha))
        left = next_left
    found["D8"] = _dominance(weights)
    return found


def _dominance(weights: Sequence[tuple[int, Rounded]]) -> list[tuple[tuple[int, ...], float]]:
    if not weights:
        return []
    winner, best = max(weights, key=lambda pair: pair[1].value)
    return [((winner, i), distance(best, weight)) for i, weight in weights if i != winner]


def _sigma(m: Magnitudes, px: float, py: float) -> Rounded:
    A, B, C = m.conic
    u, v = m.mean2d
    value = sigma_at_pixel((u.value, v.value), (A.value, B.value, C.value), px, py)
    dx, dy = u.value - px, v.value - py
    inherited = 0.5 * (A.error * dx * dx + C.error * dy * dy) + B.error * abs(dx * dy)
    inherited += abs(A.value * dx + B.value * dy) * u.error + abs(B.value * dx + C.value * dy) * v.error
    if inherited == 0.0 and in_float32(value):
        return Rounded(value)
    terms = 0.5 * (A.value * dx * dx + C.value * dy * dy) + abs(B.value * dx * dy)
    # each term is a product of four rounded factors, then summed
    return Rounded(value, inherited + 5.0 * terms)


def _raw_alpha(sigma: Rounded, opacity: Rounded) -> Rounded:
    G = falloff(sigma.value)
    if sigma.value == 0.0 and sigma.error == 0.0:
        return opacity
    # exp turns an absolute error into a relative one and adds about an eps; the product adds another
    return Rounded(opacity.value * G, G * opacity.error + opacity.value * G * (sigma.error + 2.0))


Rect = tuple[int, int, int, int]


class ExtentMargins(NamedTuple):
    """Distances in units of eps, and which tiles a flip can touch.

    Attributes:
        visible: is it on the screen at all (D2).
        size: do its integer extents change (D2); infinite where it is culled.
        overlap: does its tile rectangle change with the extents fixed (D3); infinite where it is culled.
        outer: the rectangle one px larger, as if it were not culled.
        inner: the rectangle one px smaller; flips of size and overlap touch tiles in `outer` and not in `inner`.
    """

    visible: float
    size: float
    overlap: float
    outer: Rect
    inner: Rect


class _Axis(NamedTuple):
    center: Rounded
    radius: int
    size: int


def extent_margins(m: Magnitudes, width: int, height: int, profile: Profile) -> ExtentMargins:
    """Measure D2 and D3 of one Gaussian in front of the camera.

    A Gaussian is kept if all conditions hold, so the distance is the smallest of the conditions' when it is kept and
    the largest of the failing ones' when it is culled. Of numbers that overflowed nothing is known: the distance is 0.

    Source: the conditions of `footprint.radii_from_covars2d`, `footprint.on_screen` and `tiles.tile_rects`.
    Departs: nothing.

    Args:
        m: the Gaussian's numbers with their errors.
        width: px.
        height: px.
        profile: the kind of extent, and the tile size.

    Returns:
        The distances.

    Example:
        >>> from pop_ref.constants import PAPER
        >>> one = Rounded(1.0, 1.0)
        >>> m = Magnitudes(one, (Rounded(4.0), Rounded(4.0)), (one, one), (one, one, one), one, (one, one, one), one)
        >>> extent_margins(m, 8, 8, PAPER).outer
        (0, 0, 1, 1)
    """
    reaches = _reaches(m, profile)
    if not all(math.isfinite(number.value) for number in (*m.mean2d, m.det, *reaches)):
        # what has overflowed may be anywhere, or nowhere
        return ExtentMargins(
            0.0, math.inf, math.inf, (0, 0, *grid_size(width, height, profile.tile_size)), (0, 0, 0, 0)
        )
    conditions = [(m.det.value > 0.0, distance(m.det, Rounded(0.0)))]
    if profile.extent == "opacity_aware":
        floor = constant(profile.alpha_floor)
        conditions.append((m.opacity.value >= floor.value, distance(m.opacity, floor)))
    radii = [max(1, math.ceil(reach.value)) for reach in reaches]
    axes = [_Axis(m.mean2d[0], radii[0], width), _Axis(m.mean2d[1], radii[1], height)]
    for axis in axes:
        conditions.extend(_on_screen(axis, profile))
    visible = all(holds for holds, _ in conditions)
    outer, inner = (_rect(m, [r + grow for r in radii], width, height, profile) for grow in (1, -1))
    if not visible:
        return ExtentMargins(max(d for holds, d in conditions if not holds), math.inf, math.inf, outer, inner)
    return ExtentMargins(
        visible=min(d for _, d in conditions),
        size=min(distance(reach, Rounded(float(max(1, round(reach.value))))) for reach in reaches),
        overlap=min(_overlap(axis, profile) for axis in axes),
        outer=outer,
        inner=inner,
    )


def _reaches(m: Magnitudes, profile: Profile) -> tuple[Rounded, Rounded]:
    a, _, c = m.blurred
    largest_k = constant(profile.extent_sigmas)
    if profile.extent == "square":
        middle = Rounded(0.5) * (a + c)
        spread = middle * middle - m.det
        if spread.value < 0.1:
            spread = constant(0.1)
        reach = largest_k * (middle + spread.sqrt()).sqrt()
        return reach, reach
    profile.require_floor()
    # under the floor the Gaussian is culled whatever its reach; log 1 = 0 stands in
    ratio = m.opacity / constant(profile.alpha_floor)
    log = Rounded(math.log(max(1.0, ratio.value)), ratio.error / max(1.0, ratio.value))
    k = (Rounded(2.0) * log).sqrt()
    if k.value > largest_k.value:
        k = largest_k
    return k * a.sqrt(), k * c.sqrt()


def _on_screen(axis: _Axis, profile: Profile) -> list[tuple[bool, float]]:
    radius = Rounded(float(axis.radius))
    first, last = axis.center - radius, axis.center + radius
    low, high = Rounded(0.0), Rounded(float(axis.size))
    if profile.extent == "square":
        # the tile rectangle is not empty: trunc((u - 0.5 + r + t - 1) / t) >= 1 and trunc((u - 0.5 - r) / t) < tiles
        tiles, _ = grid_size(axis.size, 1, profile.tile_size)
        low, high = Rounded(1.5), Rounded(tiles * profile.tile_size + 0.5)
        return [(last.value >= low.value, distance(last, low)), (first.value < high.value, distance(first, high))]
    return [(last.value > low.value, distance(last, low)), (first.value < high.value, distance(first, high))]


def _overlap(axis: _Axis, profile: Profile) -> float:
    size = profile.tile_size
    tiles, _ = grid_size(axis.size, 1, size)
    first, last = axis.center - Rounded(float(axis.radius)), axis.center + Rounded(float(axis.radius))
    last_edges = (0, tiles - 1)
    if profile.extent == "square":
        first, last = first - Rounded(0.5), last + Rounded(size - 1.5)
        last_edges = (1, tiles)
    # only a flip across an edge inside the grid changes the clipped rectangle
    first_edge = min(max(round(first.value / size), 1), tiles)
    last_edge = min(max(round(last.value / size), last_edges[0]), last_edges[1])
    return min(distance(first, Rounded(float(first_edge * size))), distance(last, Rounded(float(last_edge * size))))


def _rect(m: Magnitudes, radii: list[int], width: int, height: int, profile: Profile) -> Rect:
    tiles_x, tiles_y = grid_size(width, height, profile.tile_size)
    x0, x1 = tile_span(m.mean2d[0].value, radii[0], tiles_x, profile.tile_size, profile)
    y0, y1 = tile_span(m.mean2d[1].value, radii[1], tiles_y, profile.tile_size, profile)
    return x0, y0, x1, y1
