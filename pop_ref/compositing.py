"""Every pixel of an image, blended from its tile's list (`pixel` says how one is), and the transpose."""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.constants import PAPER, Profile
from pop_ref.dominance import dominant_counts, dominant_id
from pop_ref.pixel import BlendGradients, composite_pixel, composite_pixel_vjp, rows_from_splats, zero_gradients
from pop_ref.records import Render, Splats
from pop_ref.tiles import listed_pixels

__all__ = ["composite", "composite_vjp", "composite_pixel", "composite_pixel_vjp"]


def composite(
    splats: Splats,
    lists: list[list[int]],
    width: int,
    height: int,
    tile_size: int,
    background: Float64[np.ndarray, " D"] | None = None,
    profile: Profile = PAPER,
) -> Render:
    """Blend every pixel from its tile's list and note what was decided.

    Source: POP paper, eqs. 1 and 5; Kerbl et al. 2023 (3DGS), algorithm 2.
    Departs: as `composite_pixel` (D5, D6, D7) and `dominance.dominant_id` (D8).

    Args:
        splats: the projected Gaussians, any number of colour channels.
        lists: ids front to back, one list a tile, row-major.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.
        background: colour behind everything, default black.
        profile: floor, ceiling and stop.

    Returns:
        The render.

    Raises:
        ValueError: the lists or the background do not fit.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[0.5, 0.5]]), a([4.0]), a([[1.0, 0.0, 1.0]]), a([0.5]), a([[1.0]]), a([[3, 3]]))
        >>> render = composite(splats, [[0]], 1, 1, 16, background=a([8.0]))
        >>> render.image[0, 0], render.dominant_ids[0, 0].item()
        (array([4.5]), 0)
    """
    rows = rows_from_splats(splats)
    behind = background_or_black(background, splats.colors.shape[1])
    image = np.zeros((height, width, len(behind)))
    T_final, dominant_weights = np.zeros((height, width)), np.zeros((height, width))
    dominant_ids, n_blended, n_traversed = (np.zeros((height, width), dtype=np.int64) for _ in range(3))
    for x, y, ids in listed_pixels(lists, width, height, tile_size):
        pixel = composite_pixel(ids, rows, x + 0.5, y + 0.5, behind, profile)
        image[y, x] = pixel.color
        T_final[y, x] = pixel.T_final
        dominant_ids[y, x] = dominant_id(pixel.ids, pixel.weights)
        dominant_weights[y, x] = max(pixel.weights, default=0.0)
        n_blended[y, x] = len(pixel.ids)
        n_traversed[y, x] = pixel.n_traversed
    counts = dominant_counts(dominant_ids, len(rows.opacities))
    return Render(image, T_final, dominant_ids, dominant_weights, counts, n_blended, n_traversed, splats, lists)


def composite_vjp(
    splats: Splats,
    lists: list[list[int]],
    width: int,
    height: int,
    tile_size: int,
    v_image: Float64[np.ndarray, "H W D"],
    v_T_final: Float64[np.ndarray, "H W"] | None = None,
    background: Float64[np.ndarray, " D"] | None = None,
    profile: Profile = PAPER,
) -> BlendGradients:
    """Pull cotangents of the image and of the remaining transmittance back to the splats and the background.

    Source: transpose of `composite`; the absolute sum is AbsGS, Ye et al. 2024.
    Departs: nothing; a rasterizer's "alpha" output is 1 - T_final, so its cotangent is -v_T_final.

    Args:
        splats: the projected Gaussians.
        lists: ids front to back, one list a tile, row-major.
        width: px.
        height: px.
        tile_size: px, the one the lists were made with.
        v_image: cotangent of the image.
        v_T_final: cotangent of the remaining transmittance, default zero.
        background: colour behind everything, default black.
        profile: as in the forward pass.

    Returns:
        The cotangents, summed over pixels; rows that no pixel blended are exactly zero.

    Raises:
        ValueError: the lists, the background or a cotangent do not fit.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[0.5, 0.5]]), a([4.0]), a([[1.0, 0.0, 1.0]]), a([0.5]), a([[1.0]]), a([[3, 3]]))
        >>> composite_vjp(splats, [[0]], 1, 1, 16, np.ones((1, 1, 1)), background=a([8.0])).v_opacities
        array([-7.])
    """
    rows = rows_from_splats(splats)
    n_channels = splats.colors.shape[1]
    behind = background_or_black(background, n_channels)
    shapes = {"v_image": (height, width, n_channels), "v_T_final": (height, width)}
    for (name, shape), v in zip(shapes.items(), (v_image, v_T_final), strict=True):
        if v is not None and v.shape != shape:
            raise ValueError(f"{name} has shape {list(v.shape)}; it must be {list(shape)}")
    totals = zero_gradients(len(rows.opacities), n_channels)
    for x, y, ids in listed_pixels(lists, width, height, tile_size):
        px, py = x + 0.5, y + 0.5
        pixel = composite_pixel(ids, rows, px, py, behind, profile)
        v_T = 0.0 if v_T_final is None else float(v_T_final[y, x])
        composite_pixel_vjp(pixel, rows, px, py, behind, v_image[y, x].tolist(), v_T, totals, profile)
    return totals


def background_or_black(background: Float64[np.ndarray, " D"] | None, n_channels: int) -> list[float]:
    """Unpack a background, or make a black one.

    Source: bookkeeping.
    Departs: nothing.

    Args:
        background: colour behind everything, None for black.
        n_channels: number of colour channels.

    Returns:
        One number a channel.

    Raises:
        ValueError: the background has another number of channels.

    Example:
        >>> background_or_black(None, 2), background_or_black(np.array([0.5]), 1)
        ([0.0, 0.0], [0.5])
    """
    if background is None:
        return [0.0] * n_channels
    if background.shape != (n_channels,):
        raise ValueError(f"background has shape {list(background.shape)}; it must be [{n_channels}], as the colours")
    return background.tolist()
