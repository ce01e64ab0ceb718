"""Depth as a channel: accumulated, and expected where the accumulated depth is divided by the opacity of the pixel.

The depth that a pixel accumulates is D = sum_i T_i alpha_i z_i, with the camera z of each splat's centre: a colour
channel like any other, over a background of 0. The expected depth is E = D / max(A, 1e-10) with A = 1 - T_final.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.records import Splats

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RENDER_MODES: Final = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
SMALLEST_OPACITY: Final = 1e-10


def with_depth_channel(splats: Splats, render_mode: RenderMode = "RGB") -> Splats:
    """Give splats the channels of a render mode: colours, depths, or colours and then depths.

    Source: gsplat v1.5.3, `rasterization`: `render_mode`.
    Departs: nothing; a splat's depth is the camera z of its centre, constant over its pixels.

    Args:
        splats: the projected Gaussians.
        render_mode: RGB, D, ED, RGB+D or RGB+ED.

    Returns:
        The splats with those channels.

    Raises:
        ValueError: the mode is none of these.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[0.5, 0.5]]), a([4.0]), a([[1.0, 0.0, 1.0]]), a([0.5]), a([[1.0]]), a([[3, 3]]))
        >>> with_depth_channel(splats, "RGB+D").colors, with_depth_channel(splats, "ED").colors
        (array([[1., 4.]]), array([[4.]]))
    """
    if render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode is {render_mode!r}; it must be one of {', '.join(RENDER_MODES)}")
    if render_mode == "RGB":
        return splats
    depths = splats.depths[:, None]
    colored = render_mode.startswith("RGB")
    return replace(splats, colors=np.concatenate((splats.colors, depths), axis=1) if colored else depths)


def expected_depth(
    depth: Float64[np.ndarray, "H W"], T_final: Float64[np.ndarray, "H W"]
) -> Float64[np.ndarray, "H W"]:
    """Divide the accumulated depth by the opacity of the pixel: `E = D / max(1 - T_final, 1e-10)`.

    Source: gsplat v1.5.3, `rasterization`: modes ED and RGB+ED.
    Departs: nothing; where no splat is blended, D is 0 and so is E.

    Args:
        depth: accumulated depth D, world units.
        T_final: transmittance after the last blended splat.

    Returns:
        The expected depth, world units.

    Example:
        >>> expected_depth(np.array([[1.0, 0.0]]), np.array([[0.75, 1.0]]))
        array([[4., 0.]])
    """
    return depth / np.maximum(1.0 - T_final, SMALLEST_OPACITY)


def expected_depth_vjp(
    depth: Float64[np.ndarray, "H W"], T_final: Float64[np.ndarray, "H W"], v: Float64[np.ndarray, "H W"]
) -> tuple[Float64[np.ndarray, "H W"], Float64[np.ndarray, "H W"]]:
    """Pull a cotangent of the expected depth back: `v_D = v / A`, `v_T = v D / A^2` with `A = max(1 - T_final, 1e-10)`.

    Source: transpose of `expected_depth`.
    Departs: where 1 - T_final is under 1e-10 the divisor is a constant, and v_T is 0.

    Args:
        depth: accumulated depth D, world units.
        T_final: transmittance after the last blended splat.
        v: cotangent of the expected depth.

    Returns:
        Cotangents of the accumulated depth and of the transmittance.

    Example:
        >>> expected_depth_vjp(np.array([[1.0]]), np.array([[0.75]]), np.array([[1.0]]))
        (array([[4.]]), array([[16.]]))
    """
    opacity = 1.0 - T_final
    divisor = np.maximum(opacity, SMALLEST_OPACITY)
    return v / divisor, np.where(opacity >= SMALLEST_OPACITY, v * depth / divisor**2, 0.0)
