"""One pixel: front-to-back blending with early ray termination, and its transpose.

With T_1 = 1 and T_{i+1} = T_i (1 - alpha_i), a pixel is C = sum_i T_i alpha_i c_i + T_final background. Let g be the
cotangent of C, q_i = c_i . g the product of splat i's colour with it, and β_i that of the colour behind splat i:
β_m = background . g + v_T_final behind the last splat, and β_{i-1} = alpha_i q_i + (1 - alpha_i) β_i. Then
    dL/dalpha_i = T_i (q_i - β_i),    dL/dc_i = T_i alpha_i g,
so one scalar, walked from back to front, is all the backward pass carries: it never divides by 1 - alpha.
"""

# T is the field's symbol for transmittance, and it changes along a ray
# pyright: reportConstantRedefinition=false

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.alpha import alpha_from_sigma, alpha_from_sigma_vjp, sigma_at_pixel, sigma_at_pixel_vjp
from pop_ref.constants import PAPER, Profile
from pop_ref.records import Splats


class SplatRows(NamedTuple):
    """The columns of `Splats` that blending reads, as lists of Python floats: scalar loops are fast on those."""

    means2d: Sequence[Sequence[float]]
    conics: Sequence[Sequence[float]]
    opacities: Sequence[float]
    colors: Sequence[Sequence[float]]


class Pixel(NamedTuple):
    """One blended pixel: its colour, what is left of T, and of each blended splat its id, alpha and T before it."""

    color: list[float]
    T_final: float
    ids: list[int]
    alphas: list[float]
    transmittances: list[float]
    n_traversed: int

    @property
    def weights(self) -> list[float]:
        """Multiply `T alpha` for each blended splat."""
        return [T * alpha for T, alpha in zip(self.transmittances, self.alphas, strict=True)]


class BlendGradients(NamedTuple):
    """Cotangents of what blending reads.

    `v_means2d_abs` sums absolute values over pixels (AbsGS), which is not a cotangent but lives and dies with them.
    """

    v_means2d: Float64[np.ndarray, "N 2"]
    v_conics: Float64[np.ndarray, "N 3"]
    v_opacities: Float64[np.ndarray, " N"]
    v_colors: Float64[np.ndarray, "N D"]
    v_background: Float64[np.ndarray, " D"]
    v_means2d_abs: Float64[np.ndarray, "N 2"]


def rows_from_splats(splats: Splats) -> SplatRows:
    """Unpack splats into lists of Python floats.

    Source: bookkeeping.
    Departs: nothing.

    Args:
        splats: the projected Gaussians.

    Returns:
        The same numbers.

    Example:
        >>> a = np.array
        >>> splats = Splats(a([[1.0, 2.0]]), a([4.0]), a([[1.0, 0.0, 1.0]]), a([0.5]), a([[1.0]]), a([[3, 3]]))
        >>> rows_from_splats(splats).means2d
        [[1.0, 2.0]]
    """
    return SplatRows(splats.means2d.tolist(), splats.conics.tolist(), splats.opacities.tolist(), splats.colors.tolist())


def stops(next_T: float, profile: Profile = PAPER) -> bool:
    """Tell whether a pixel ends before the splat that would leave `next_T` (D7).

    Source: POP paper, section 3.1: early ray termination at `T_{i+1} <= 1e-4`.
    Departs: Inria stops at `<`. Inria and gsplat leave the terminating splat unblended, as here; Faster-GS and LiteGS
        blend it (D7). In every profile the second of two opaque splats is the terminating one: they would leave 1e-6
        under a ceiling of 0.999, and 9.99998e-5 under the 0.99 of float32, which the profiles therefore hold (see
        `constants`).

    Args:
        next_T: the transmittance that would be left behind the splat.
        profile: the stop and its strictness.

    Returns:
        True where the pixel ends and the splat is not blended.

    Example:
        >>> stops(1e-4), stops(0.5)
        (True, False)
    """
    return next_T <= profile.transmittance_stop if profile.stop_inclusive else next_T < profile.transmittance_stop


def composite_pixel(
    ids: Sequence[int],
    rows: SplatRows,
    px: float,
    py: float,
    background: Sequence[float],
    profile: Profile = PAPER,
) -> Pixel:
    """Blend one pixel front to back: `C = sum_i T_i alpha_i c_i + T_final background`.

    Source: POP paper, eq. 1; Kerbl et al. 2023 (3DGS), eq. 3.
    Departs: splats under the alpha floor are skipped (D5), alpha is clamped (D6), and the pixel ends before the splat
        that would take T to the stop (D7); the paper has the last only.

    Args:
        ids: the tile's list, front to back.
        rows: the splats.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.
        background: colour behind everything.
        profile: floor, ceiling and stop.

    Returns:
        The pixel. `n_traversed` counts the entries visited, the terminating one included.

    Example:
        >>> rows = SplatRows([[0.5, 0.5]] * 2, [[1.0, 0.0, 1.0]] * 2, [0.5, 0.25], [[1.0], [2.0]])
        >>> pixel = composite_pixel([1, 0], rows, 0.5, 0.5, [8.0])
        >>> pixel.color, pixel.T_final, pixel.weights
        ([3.875], 0.375, [0.25, 0.375])
    """
    color = [0.0] * len(background)
    T = 1.0
    blended: list[int] = []
    alphas: list[float] = []
    transmittances: list[float] = []
    n_traversed = 0
    for i in ids:
        n_traversed += 1
        sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py)
        alpha, skipped = alpha_from_sigma(sigma, rows.opacities[i], profile)
        if skipped:
            continue
        next_T = T * (1.0 - alpha)
        if stops(next_T, profile):
            break
        weight = T * alpha
        for k, c in enumerate(rows.colors[i]):
            color[k] += weight * c
        blended.append(i)
        alphas.append(alpha)
        transmittances.append(T)
        T = next_T
    for k, b in enumerate(background):
        color[k] += T * b
    return Pixel(color, T, blended, alphas, transmittances, n_traversed)


def composite_pixel_vjp(
    pixel: Pixel,
    rows: SplatRows,
    px: float,
    py: float,
    background: Sequence[float],
    v_color: Sequence[float],
    v_T_final: float,
    totals: BlendGradients,
    profile: Profile = PAPER,
) -> None:
    """Add one pixel's cotangents to the totals, walking its blended splats from back to front.

    See the module's text for the recurrence. Which splats are blended is held fixed (D4, D5, D7).

    Source: transpose of `composite_pixel`.
    Departs: CUDA codes recover T by dividing by 1 - alpha; here T is kept from the forward pass.

    Args:
        pixel: what `composite_pixel` returned.
        rows: the splats.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.
        background: colour behind everything.
        v_color: cotangent of the pixel's colour.
        v_T_final: cotangent of the pixel's remaining transmittance.
        totals: the sums over pixels, added to in place.
        profile: as in the forward pass.

    Example:
        >>> rows = SplatRows([[0.5, 0.5]], [[1.0, 0.0, 1.0]], [0.5], [[1.0]])
        >>> pixel = composite_pixel([0], rows, 0.5, 0.5, [8.0])
        >>> totals = zero_gradients(1, 1)
        >>> composite_pixel_vjp(pixel, rows, 0.5, 0.5, [8.0], [1.0], 0.0, totals)
        >>> totals.v_opacities, totals.v_colors, totals.v_background
        (array([-7.]), array([[0.5]]), array([0.5]))
    """
    suffix_dot_grad = v_T_final
    for k, b in enumerate(background):
        totals.v_background[k] += pixel.T_final * v_color[k]
        suffix_dot_grad += b * v_color[k]
    for i, alpha, T in zip(reversed(pixel.ids), reversed(pixel.alphas), reversed(pixel.transmittances), strict=True):
        color_dot_grad = 0.0
        for k, c in enumerate(rows.colors[i]):
            color_dot_grad += c * v_color[k]
            totals.v_colors[i, k] += T * alpha * v_color[k]
        v_alpha = T * (color_dot_grad - suffix_dot_grad)
        suffix_dot_grad += alpha * (color_dot_grad - suffix_dot_grad)
        sigma = sigma_at_pixel(rows.means2d[i], rows.conics[i], px, py)
        v_sigma, v_opacity = alpha_from_sigma_vjp(sigma, rows.opacities[i], v_alpha, profile)
        v_mean2d, v_conic = sigma_at_pixel_vjp(rows.means2d[i], rows.conics[i], px, py, v_sigma)
        totals.v_opacities[i] += v_opacity
        totals.v_means2d[i] += v_mean2d
        totals.v_means2d_abs[i] += (abs(v_mean2d[0]), abs(v_mean2d[1]))
        totals.v_conics[i] += v_conic


def zero_gradients(n: int, n_channels: int) -> BlendGradients:
    """Make totals to start from.

    Source: bookkeeping.
    Departs: nothing.

    Args:
        n: number of Gaussians.
        n_channels: number of colour channels.

    Returns:
        Zeros.

    Example:
        >>> zero_gradients(2, 3).v_colors.shape
        (2, 3)
    """
    shapes = (n, 2), (n, 3), (n,), (n, n_channels), (n_channels,), (n, 2)
    return BlendGradients(*(np.zeros(shape) for shape in shapes))
