"""What each Gaussian adds to a view: its weights, its pixels, and sums over them.

Importance scores of the pruning and budgeting methods are made of these: Mini-Splatting's reads weights and pixels,
Taming-3DGS reads all four. Only blended splats contribute, the same that a render blends (D5, D7).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.constants import PAPER, Profile
from pop_ref.pixel import composite_pixel, rows_from_splats
from pop_ref.records import Splats
from pop_ref.tiles import listed_pixels


@dataclass(frozen=True)
class Contributions:
    """Sums over the pixels of one view at which a Gaussian is blended.

    Attributes:
        weight_sum: of T alpha. [N]
        n_pixels: how many there are. [N]
        map_sum: of a given map, 0 without one. [N]
        distance_sum: of the distances from the pixels' centres to the screen centre, px. [N]
    """

    weight_sum: Float64[np.ndarray, " N"]
    n_pixels: Int64[np.ndarray, " N"]
    map_sum: Float64[np.ndarray, " N"]
    distance_sum: Float64[np.ndarray, " N"]


def contributions(
    splats: Splats,
    lists: list[list[int]],
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Float64[np.ndarray, "H W"] | None = None,
    profile: Profile = PAPER,
) -> Contributions:
    """Sum `T alpha`, 1, `pixel_map` and `|p - mean2d|` over the pixels at which each Gaussian is blended.

    Source: Fang and Wang 2024 (Mini-Splatting) and Mallick et al. 2024 (Taming-3DGS), and their code.
    Departs: nothing; colours and background take no part.

    Args:
        splats: the projected Gaussians.
        lists: ids front to back, one list a tile, row-major.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.
        pixel_map: what `map_sum` adds up, default zero.
        profile: floor, ceiling and stop.

    Returns:
        The four sums; rows that no pixel blended are exactly zero.

    Raises:
        ValueError: the lists or the map do not fit.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[0.5, 0.5]]), a([4.0]), a([[0.0, 0.0, 0.0]]), a([0.5]), a([[1.0]]), a([[3, 3]]))
        >>> found = contributions(splats, [[0]], 2, 1, 16, pixel_map=a([[1.0, 0.25]]))
        >>> found.weight_sum, found.n_pixels, found.map_sum, found.distance_sum
        (array([1.]), array([2]), array([1.25]), array([1.]))
    """
    if pixel_map is not None and pixel_map.shape != (height, width):
        raise ValueError(f"pixel_map has shape {list(pixel_map.shape)}; it must be [{height}, {width}]")
    rows = rows_from_splats(splats)
    black = [0.0] * splats.colors.shape[1]
    n = len(rows.opacities)
    weight_sum, map_sum, distance_sum = np.zeros(n), np.zeros(n), np.zeros(n)
    n_pixels = np.zeros(n, dtype=np.int64)
    for x, y, ids in listed_pixels(lists, width, height, tile_size):
        pixel = composite_pixel(ids, rows, x + 0.5, y + 0.5, black, profile)
        for i, weight in zip(pixel.ids, pixel.weights, strict=True):
            u, v = rows.means2d[i]
            weight_sum[i] += weight
            n_pixels[i] += 1
            map_sum[i] += 0.0 if pixel_map is None else pixel_map[y, x]
            distance_sum[i] += math.hypot(x + 0.5 - u, y + 0.5 - v)
    return Contributions(weight_sum, n_pixels, map_sum, distance_sum)
