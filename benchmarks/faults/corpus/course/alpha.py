from __future__ import annotations

from collections.abc import Sequence
import math

from pop_ref.constants import PAPER, Profile


def sigma_at_pixel(mean2d: Sequence[float], conic: Sequence[float], px: float, py: float) -> float:
    A, B, C = conic
    dx = mean2d[0] - px
    dy = mean2d[1] - py
    return 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy


def sigma_at_pixel_vjp(
    mean2d: Sequence[float], conic: Sequence[float], px: float, py: float, v_sigma: float
) -> tuple[tuple[float, float], tuple[float, float, float]]:
    A, B, C = conic
    dx = mean2d[0] - px
    dy = mean2d[1] - py
    v_mean2d = (v_sigma * (A * dx + B * dy), v_sigma * (B * dx + C * dy))
    v_conic = (v_sigma * 0.5 * dx * dx, v_sigma * dx * dy, v_sigma * 0.5 * dy * dy)
    return v_mean2d, v_conic


def falloff(sigma: float) -> float:
    return math.exp(-sigma)


def falloff_vjp(sigma: float, v_falloff: float) -> float:
    return -math.exp(-sigma) * v_falloff


def alpha_from_sigma(sigma: float, opacity: float, profile: Profile = PAPER) -> tuple[float, bool]:
    if sigma < 0.0:
        return 0.0, True
    alpha = min(profile.alpha_ceiling, opacity * falloff(sigma))
    return alpha, alpha < profile.alpha_floor


def alpha_from_sigma_vjp(sigma: float, opacity: float, v_alpha: float, profile: Profile = PAPER) -> tuple[float, float]:
    _, skipped = alpha_from_sigma(sigma, opacity, profile)
    if skipped:
        return 0.0, 0.0
    if opacity * falloff(sigma) > profile.alpha_ceiling and profile.ceiling_gradient == "zero":
        return 0.0, 0.0
    return falloff_vjp(sigma, opacity * v_alpha), falloff(sigma) * v_alpha
