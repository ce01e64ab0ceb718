"""One splat at one pixel: exponent, falloff, alpha, and their transposes, as scalars.

These are the innermost formulas. They are written on Python floats, one statement a step, so that a compiled
implementation can be read next to them line by line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pop_ref.constants import PAPER, Profile


def sigma_at_pixel(mean2d: Sequence[float], conic: Sequence[float], px: float, py: float) -> float:
    """Evaluate the exponent of a splat: `sigma = (A dx^2 + C dy^2) / 2 + B dx dy` with `d = mean2d - p`.

    Source: POP paper, eq. 11.
    Departs: nothing.

    Args:
        mean2d: screen centre, px.
        conic: (A, B, C) = (xx, xy, yy), px^-2.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.

    Returns:
        sigma, 1; negative only where rounding spoilt the conic.

    Example:
        >>> sigma_at_pixel((2.0, 1.0), (1.0, 0.5, 2.0), 0.5, 0.5)
        1.75
    """
    A, B, C = conic
    dx = mean2d[0] - px
    dy = mean2d[1] - py
    return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy


def sigma_at_pixel_vjp(
    mean2d: Sequence[float], conic: Sequence[float], px: float, py: float, v_sigma: float
) -> tuple[tuple[float, float], tuple[float, float, float]]:
    """Pull a cotangent of sigma back: `v_mean = v_sigma Q d`, `v_conic = v_sigma (dx^2/2, dx dy, dy^2/2)`.

    Source: transpose of `sigma_at_pixel`.
    Departs: nothing; Inria stores half of the off-diagonal's cotangent and doubles it later.

    Args:
        mean2d: screen centre, px.
        conic: (A, B, C) = (xx, xy, yy), px^-2.
        px: the pixel's centre along x, its index + 0.5.
        py: the same along y.
        v_sigma: cotangent of sigma.

    Returns:
        Cotangents of `mean2d` and `conic`.

    Example:
        >>> sigma_at_pixel_vjp((2.0, 1.0), (1.0, 0.5, 2.0), 0.5, 0.5, 1.0)
        ((1.75, 1.75), (1.125, 0.75, 0.125))
    """
    A, B, C = conic
    dx = mean2d[0] - px
    dy = mean2d[1] - py
    v_mean2d = (v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy))
    v_conic = (v_sigma * 0.5 * dx * dx, v_sigma * dx * dy, v_sigma * 0.5 * dy * dy)
    return v_mean2d, v_conic


def falloff(sigma: float) -> float:
    """Evaluate the splat's Gaussian: `G = exp(-sigma)`.

    Source: POP paper, eq. 11.
    Departs: nothing.

    Args:
        sigma: exponent, >= 0.

    Returns:
        G in [0, 1].

    Example:
        >>> falloff(0.0)
        1.0
    """
    return math.exp(-sigma)


def falloff_vjp(sigma: float, v_falloff: float) -> float:
    """Pull a cotangent of the falloff back: `v_sigma = -exp(-sigma) v_G`.

    Source: transpose of `falloff`.
    Departs: nothing.

    Args:
        sigma: exponent, >= 0.
        v_falloff: cotangent of G.

    Returns:
        Cotangent of `sigma`.

    Example:
        >>> falloff_vjp(0.0, 2.0)
        -2.0
    """
    return -math.exp(-sigma) * v_falloff


def alpha_from_sigma(sigma: float, opacity: float, profile: Profile = PAPER) -> tuple[float, bool]:
    """Evaluate a splat's alpha at a pixel: `alpha = min(ceiling, o exp(-sigma))` (D6), and whether it is skipped (D5).

    Source: POP paper, eqs. 1 and 11.
    Departs: the paper has neither the ceiling (D6) nor the floor (D5); the code bases have both, and skip sigma < 0.

    Args:
        sigma: exponent, 1.
        opacity: the opacity that blends, 1.
        profile: floor and ceiling.

    Returns:
        alpha, and True where the splat does not take part at this pixel: `sigma < 0` (alpha is then given as 0) or
        `alpha < floor`.

    Example:
        >>> alpha_from_sigma(0.0, 0.5)
        (0.5, False)
        >>> alpha_from_sigma(0.0, 1.0), alpha_from_sigma(0.0, 1.0 / 256.0)
        ((0.999, False), (0.00390625, True))
    """
    if sigma < 0.0:
        return 0.0, True
    alpha = min(profile.alpha_ceiling, opacity * falloff(sigma))
    return alpha, alpha < profile.alpha_floor


def alpha_from_sigma_vjp(sigma: float, opacity: float, v_alpha: float, profile: Profile = PAPER) -> tuple[float, float]:
    """Pull a cotangent of alpha back: `v_sigma = -o exp(-sigma) v_alpha`, `v_o = exp(-sigma) v_alpha`.

    B3: where `o exp(-sigma) > ceiling`, "zero" passes nothing and "pass" passes all, as if there were no ceiling. At
    exactly the ceiling the derivative from below is used. A skipped splat passes nothing.

    Source: transpose of `alpha_from_sigma`; gsplat v1.5 ("zero"), diff-gaussian-rasterization ("pass").
    Departs: "pass" is not the derivative of the clamped alpha (B3).

    Args:
        sigma: exponent, 1.
        opacity: the opacity that blends, 1.
        v_alpha: cotangent of alpha.
        profile: floor, ceiling and the ceiling's gradient.

    Returns:
        Cotangents of `sigma` and `opacity`; both 0 for a splat that does not take part, and over the ceiling.

    Example:
        >>> alpha_from_sigma_vjp(0.0, 0.5, 4.0), alpha_from_sigma_vjp(0.0, 1.0, 4.0)
        ((-2.0, 4.0), (0.0, 0.0))
    """
    _, skipped = alpha_from_sigma(sigma, opacity, profile)
    if skipped:
        return 0.0, 0.0
    if opacity * falloff(sigma) > profile.alpha_ceiling and profile.ceiling_gradient == "zero":
        return 0.0, 0.0
    return falloff_vjp(sigma, opacity * v_alpha), falloff(sigma) * v_alpha
