"""Tile lists and depth order: which splats a tile's pixels must look at, front to back.

Where extents are opacity-aware, tiling is only an optimisation: any tile size gives the same image. In profile `inria`
the square cuts visible alpha off and the tile grid decides where, so its 16 px belong to its meaning (D3).
"""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.constants import PAPER, Profile


def grid_size(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """Count the tiles that cover an image: `(ceil(W / t), ceil(H / t))`.

    Source: Kerbl et al. 2023 (3DGS), section 6.
    Departs: nothing.

    Args:
        width: px.
        height: px.
        tile_size: px.

    Returns:
        Tiles along x and along y.

    Raises:
        ValueError: the tile size is under 1.

    Example:
        >>> grid_size(17, 16, 16)
        (2, 1)
    """
    if tile_size < 1:
        raise ValueError(f"tile_size is {tile_size}; it must be >= 1")
    return -(-width // tile_size), -(-height // tile_size)


def tile_span(center: float, radius: int, n_tiles: int, tile_size: int, profile: Profile = PAPER) -> tuple[int, int]:
    """Find the tiles that an extent overlaps along one axis (D3).

    `floor((u - r) / t)` to `ceil((u + r) / t)`, clipped to the grid. In "square" extents, with the centre in index
    space p = u - 0.5: `trunc((p - r) / t)` to `trunc((p + r + t - 1) / t)`.

    Source: gsplat v1.5 ("opacity_aware"); diff-gaussian-rasterization ("square").
    Departs: nothing.

    Args:
        center: screen centre along the axis, px.
        radius: extent along the axis, px.
        n_tiles: tiles along the axis.
        tile_size: px.
        profile: the kind of extent.

    Returns:
        First tile, and one past the last.

    Example:
        >>> tile_span(8.0, 4, 4, 4)
        (1, 3)
    """
    if profile.extent == "square":
        index = center - 0.5
        first = int((index - radius) / tile_size)
        last = int((index + radius + tile_size - 1) / tile_size)
    else:
        first = math.floor((center - radius) / tile_size)
        last = math.ceil((center + radius) / tile_size)
    return min(max(first, 0), n_tiles), min(max(last, 0), n_tiles)


def tile_rects(
    means2d: Float64[np.ndarray, "N 2"],
    radii: Int64[np.ndarray, "N 2"],
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
) -> Int64[np.ndarray, "N 4"]:
    """Find the rectangle of tiles that each splat's extent overlaps (D3).

    `tile_span` along x and along y.

    Source: gsplat v1.5 ("opacity_aware"); diff-gaussian-rasterization ("square").
    Departs: nothing.

    Args:
        means2d: screen centres, px.
        radii: extents, px; 0 overlaps nothing.
        width: px.
        height: px.
        tile_size: px.
        profile: the kind of extent.

    Returns:
        (x0, y0, x1, y1) in tiles, half open.

    Example:
        >>> tile_rects(np.array([[8.0, 4.5]]), np.array([[4, 4]]), 16, 16, 4).tolist()
        [[1, 0, 3, 3]]
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    rects = np.zeros((len(means2d), 4), dtype=np.int64)
    for i in range(len(means2d)):
        (u, v), (r_x, r_y) = means2d[i].tolist(), radii[i].tolist()
        if r_x > 0 and r_y > 0:
            x0, x1 = tile_span(u, r_x, tiles_x, tile_size, profile)
            y0, y1 = tile_span(v, r_y, tiles_y, tile_size, profile)
            rects[i] = x0, y0, x1, y1
    return rects


def tile_lists(
    means2d: Float64[np.ndarray, "N 2"],
    radii: Int64[np.ndarray, "N 2"],
    depths: Float64[np.ndarray, " N"],
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
) -> list[list[int]]:
    """List the splats of every tile front to back: ids sorted by (depth, index) (D3, D4).

    Source: Kerbl et al. 2023 (3DGS), section 6 and algorithm 2.
    Departs: CUDA codes sort the bits of a float32 depth; here the float64 depth itself is compared. In both a stable
        sort keeps equal depths in index order (D4).

    Args:
        means2d: screen centres, px.
        radii: extents, px; 0 is in no list.
        depths: camera z, world units.
        width: px.
        height: px.
        tile_size: px.
        profile: the kind of extent.

    Returns:
        One list of ids a tile, tiles in row-major order.

    Example:
        >>> means2d, radii = np.array([[1.0, 1.0], [3.0, 1.0], [1.0, 1.0]]), np.ones((3, 2), dtype=np.int64)
        >>> tile_lists(means2d, radii, np.array([2.0, 1.0, 2.0]), 4, 2, 2)
        [[0, 2], [1]]
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    lists: list[list[int]] = [[] for _ in range(tiles_x * tiles_y)]
    rects = tile_rects(means2d, radii, width, height, tile_size, profile).tolist()
    depth_of = depths.tolist()
    for i in sorted(range(len(depth_of)), key=lambda i: (depth_of[i], i)):
        x0, y0, x1, y1 = rects[i]
        for y in range(y0, y1):
            for x in range(x0, x1):
                lists[y * tiles_x + x].append(i)
    return lists


def listed_pixels(lists: list[list[int]], width: int, height: int, tile_size: int) -> list[tuple[int, int, list[int]]]:
    """Go through an image row by row, each pixel with the list of its tile.

    Source: Kerbl et al. 2023 (3DGS), algorithm 2.
    Departs: nothing.

    Args:
        lists: ids front to back, one list a tile, tiles in row-major order.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.

    Returns:
        Column, row, and ids front to back, for each pixel.

    Raises:
        ValueError: there are not as many lists as tiles.

    Example:
        >>> listed_pixels([[0, 2], [1]], 3, 1, 2)
        [(0, 0, [0, 2]), (1, 0, [0, 2]), (2, 0, [1])]
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    if len(lists) != tiles_x * tiles_y:
        raise ValueError(
            f"lists has {len(lists)} tiles; {width} x {height} px in {tile_size} px tiles need {tiles_x * tiles_y}"
        )
    return [(x, y, lists[(y // tile_size) * tiles_x + x // tile_size]) for y in range(height) for x in range(width)]
