"""How much a view changes where one splat's Gaussian does: the pruning score of Speedy-Splat.

With alpha = o g, g the splat's Gaussian at a pixel, the summed colour of a pixel changes with g by
    d(sum_c C_c)/dg = o sum_c dC_c/dalpha = o T (sum_c c_c - suffix_color),
where `suffix_color` is the summed colour of what lies behind the splat: behind the last one the background, and then
suffix_color <- suffix_color + alpha (sum_c c_c - suffix_color) from back to front. The score adds squares over pixels.
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.compositing import background_or_black
from pop_ref.constants import PAPER, Profile
from pop_ref.pixel import composite_pixel, rows_from_splats
from pop_ref.records import Splats
from pop_ref.tiles import listed_pixels


def sensitivities(
    splats: Splats,
    lists: list[list[int]],
    width: int,
    height: int,
    tile_size: int,
    background: Float64[np.ndarray, " D"] | None = None,
    profile: Profile = PAPER,
) -> Float64[np.ndarray, " N"]:
    """Sum over a view's pixels the squared change of the summed colour: `S_i = sum_p (o_i sum_c dC_c/dalpha_i)^2`.

    A training's score of a Gaussian is the sum over its views.

    Source: Hanson et al. 2025 (Speedy-Splat).
    Departs: channels are added before squaring, as the code does. The alpha ceiling is not differentiated (B3), in any
        profile: g counts as if alpha followed it.

    Args:
        splats: the projected Gaussians, any number of colour channels.
        lists: ids front to back, one list a tile, row-major.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.
        background: colour behind everything, default black.
        profile: floor, ceiling and stop.

    Returns:
        The scores, >= 0; rows that no pixel blended are exactly zero.

    Raises:
        ValueError: the lists or the background do not fit.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[0.5, 0.5]]), a([4.0]), a([[1.0, 0.0, 1.0]]), a([0.5]), a([[1.0, 2.0]]), a([[3, 3]]))
        >>> sensitivities(splats, [[0]], 1, 1, 16), sensitivities(splats, [[0]], 1, 1, 16, background=a([1.0, 1.0]))
        (array([2.25]), array([0.25]))
    """
    rows = rows_from_splats(splats)
    black_or_given = background_or_black(background, splats.colors.shape[1])
    scores = np.zeros(len(rows.opacities))
    for x, y, ids in listed_pixels(lists, width, height, tile_size):
        pixel = composite_pixel(ids, rows, x + 0.5, y + 0.5, black_or_given, profile)
        suffix_color = sum(black_or_given)
        for i, alpha, T in zip(
            reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True
        ):
            more = sum(rows.colors[i]) - suffix_color
            scores[i] += (rows.opacities[i] * T * more) ** 2
            suffix_color += alpha * more
    return scores
