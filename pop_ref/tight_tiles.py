"""Exact tile lists: a splat is listed where the ellipse of what can be seen of it meets a tile, and nowhere else.

A pixel blends a splat where o exp(-sigma) >= alpha_floor (D5), that is inside the ellipse d^T Q d <= t with Q the conic
and t = 2 ln(o / alpha_floor). With Sigma = Q^-1 its bounding box is |dx| <= sqrt(t Sigma_xx), |dy| <= sqrt(t Sigma_yy)
(SnugBox). A row of tiles cuts a convex piece out of it, whose reach along x is an interval, so the row's tiles that
meet the ellipse are consecutive (AccuTile). Inside a row the point furthest right is the ellipse's own where that
lies in the row, at dy = Sigma_xy sqrt(t / Sigma_xx), and else lies on the row's edge nearest to it, where
    Q_xx dx^2 + 2 Q_xy dx dy + Q_yy dy^2 = t   gives   dx = (-Q_xy dy +- sqrt(Q_xx t - det Q dy^2)) / Q_xx.

The image does not change: pixel centres lie half a pixel inside their tiles, so what is blended is listed.
"""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.constants import PAPER, Profile
from pop_ref.tiles import grid_size, tile_rects


def snug_box(
    mean2d: Float64[np.ndarray, "2"], conic: Float64[np.ndarray, "3"], opacity: float, profile: Profile = PAPER
) -> tuple[float, float, float, float] | None:
    """Bound what can be seen of a splat: the box of the ellipse `o exp(-sigma) >= alpha_floor` (D2, D5).

    `u -+ sqrt(t C / det)`, `v -+ sqrt(t A / det)` with the conic (A, B, C), `det = A C - B^2` and
    `t = 2 ln(o / alpha_floor)`.

    Source: Hanson et al. 2025 (Speedy-Splat) (SnugBox).
    Departs: nothing; gsplat's opacity-aware extent is this box with its half-sides rounded up to whole pixels.

    Args:
        mean2d: screen centre, px.
        conic: (xx, xy, yy), px^-2, positive definite.
        opacity: the opacity that blends.
        profile: the alpha floor.

    Returns:
        (left, top, right, bottom), px; None where the opacity is under the floor.

    Raises:
        ValueError: the floor is not over 0.

    Example:
        >>> left, top, right, bottom = snug_box(np.array([8.0, 4.0]), np.array([0.25, 0.0, 1.0]), 1.0)
        >>> round(right - 8.0, 2), round(bottom - 4.0, 2)
        (6.66, 3.33)
    """
    profile.require_floor()
    if opacity < profile.alpha_floor:
        return None
    t = 2.0 * math.log(opacity / profile.alpha_floor)
    A, B, C = conic.tolist()
    det = A * C - B * B
    (u, v), half_x, half_y = mean2d.tolist(), math.sqrt(t * C / det), math.sqrt(t * A / det)
    return u - half_x, v - half_y, u + half_x, v + half_y


def accutile(
    mean2d: Float64[np.ndarray, "2"],
    conic: Float64[np.ndarray, "3"],
    opacity: float,
    rect: tuple[int, int, int, int],
    tile_size: int,
    profile: Profile = PAPER,
) -> list[tuple[int, int]]:
    """Find the tiles of a rectangle that the ellipse of what can be seen meets (D3).

    Source: Hanson et al. 2025 (Speedy-Splat) (AccuTile).
    Departs: the code walks along the shorter side of the rectangle, here rows are walked always: the same tiles. A
        conic that rounding left without a positive determinant has no ellipse, and gets the whole rectangle.

    Args:
        mean2d: screen centre, px.
        conic: (xx, xy, yy), px^-2.
        opacity: the opacity that blends.
        rect: (x0, y0, x1, y1) in tiles, half open, as `tiles.tile_rects` gives it.
        tile_size: px.
        profile: the alpha floor.

    Returns:
        Tiles (x, y), row by row. A tile that the ellipse touches with its edge only is not among them.

    Raises:
        ValueError: the floor is not over 0.

    Example:
        >>> accutile(np.array([8.0, 8.0]), np.array([0.5, -0.484375, 0.5]), 2.0 / 255.0, (0, 0, 4, 4), 4)
        [(0, 0), (1, 0), (0, 1), (1, 1), (2, 1), (1, 2), (2, 2), (3, 2), (2, 3), (3, 3)]
    """
    profile.require_floor()
    x0, y0, x1, y1 = rect
    A, B, C = conic.tolist()
    if opacity < profile.alpha_floor:
        return []
    if A * C - B * B <= 0.0:
        return [(x, y) for y in range(y0, y1) for x in range(x0, x1)]
    t = 2.0 * math.log(opacity / profile.alpha_floor)
    tiles: list[tuple[int, int]] = []
    for y in range(y0, y1):
        reach = _reach_in_slab(mean2d, conic, t, y * tile_size, (y + 1) * tile_size)
        if reach is not None:
            first, last = math.floor(reach[0] / tile_size), math.ceil(reach[1] / tile_size)
            tiles.extend((x, y) for x in range(max(first, x0), min(last, x1)))
    return tiles


def tight_tile_lists(
    means2d: Float64[np.ndarray, "N 2"],
    conics: Float64[np.ndarray, "N 3"],
    opacities: Float64[np.ndarray, " N"],
    radii: Int64[np.ndarray, "N 2"],
    depths: Float64[np.ndarray, " N"],
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
) -> list[list[int]]:
    """List the splats of every tile front to back, each where its visible ellipse meets the tile (D3, D4).

    A tile is listed if it lies in the rectangle of the extent and `accutile` keeps it. Where extents are square the
    rectangle cuts the ellipse off, and the lists are those of Taming-3DGS: inside the square of 3 standard deviations.

    Source: Hanson et al. 2025 (Speedy-Splat); for squares Mallick et al. 2024 (Taming-3DGS).
    Departs: nothing; the image is the same as with `tiles.tile_lists`, to the bit.

    Args:
        means2d: screen centres, px.
        conics: (xx, xy, yy), px^-2.
        opacities: the opacities that blend.
        radii: extents, px; 0 is in no list.
        depths: camera z, world units.
        width: px.
        height: px.
        tile_size: px.
        profile: the kind of extent and the alpha floor.

    Returns:
        One list of ids a tile, tiles in row-major order.

    Example:
        >>> means2d, conics = np.array([[8.0, 8.0]]), np.array([[0.5, -0.484375, 0.5]])
        >>> opacities, radii = np.array([2.0 / 255.0]), np.array([[7, 7]])
        >>> lists = tight_tile_lists(means2d, conics, opacities, radii, np.ones(1), 16, 16, 4)
        >>> [len(ids) for ids in lists]
        [1, 1, 0, 0, 1, 1, 1, 0, 0, 1, 1, 1, 0, 0, 1, 1]
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    lists: list[list[int]] = [[] for _ in range(tiles_x * tiles_y)]
    rects = tile_rects(means2d, radii, width, height, tile_size, profile).tolist()
    depth_of = depths.tolist()
    for i in sorted(range(len(depth_of)), key=lambda i: (depth_of[i], i)):
        x0, y0, x1, y1 = rects[i]
        for x, y in accutile(means2d[i], conics[i], float(opacities[i]), (x0, y0, x1, y1), tile_size, profile):
            lists[y * tiles_x + x].append(i)
    return lists


def _reach_in_slab(
    mean2d: Float64[np.ndarray, "2"], conic: Float64[np.ndarray, "3"], t: float, top: int, bottom: int
) -> tuple[float, float] | None:
    """Give the ellipse's least and greatest x inside `top <= y <= bottom`; None where it does not get inside."""
    A, B, C = conic.tolist()
    u, v = mean2d.tolist()
    det = A * C - B * B
    half_y = math.sqrt(t * A / det)
    if v + half_y <= top or v - half_y >= bottom:
        return None
    # heights, within the slab, nearest to those of the ellipse's leftmost and rightmost points
    low, high = max(top - v, -half_y), min(bottom - v, half_y)
    at_right = -B * math.sqrt(t / (C * det)) if C > 0.0 else 0.0
    dy_left, dy_right = min(max(-at_right, low), high), min(max(at_right, low), high)
    left = (-B * dy_left - math.sqrt(max(0.0, A * t - det * dy_left * dy_left))) / A
    right = (-B * dy_right + math.sqrt(max(0.0, A * t - det * dy_right * dy_right))) / A
    return u + left, u + right
