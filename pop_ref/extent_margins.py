"""How far one Gaussian's extent decisions are from flipping: cull and size (D2), tile rectangle (D3)."""

from __future__ import annotations

import math
from typing import NamedTuple

from pop_ref.constants import Profile
from pop_ref.magnitudes import Magnitudes, Rounded, constant, distance
from pop_ref.tiles import grid_size, tile_span

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
