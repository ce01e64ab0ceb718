"""Raw parameters to what the renderer uses: scales, opacities, unit quaternions.

The optimizer works on unbounded numbers; these three maps put them in range. Each stands with its transpose.
"""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Float64


def scales_from_log_scales(log_scales: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Make positive standard deviations: `scales = exp(log_scales)`.

    Source: Kerbl et al. 2023 (3DGS), section 5.1.
    Departs: nothing.

    Args:
        log_scales: natural logarithms of standard deviations in world units.

    Returns:
        Standard deviations, world units.

    Example:
        >>> scales_from_log_scales(np.array([[0.0, np.log(2.0), -np.log(4.0)]]))
        array([[1.  , 2.  , 0.25]])
    """
    return np.exp(log_scales)


def scales_from_log_scales_vjp(
    log_scales: Float64[np.ndarray, "N 3"], v_scales: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Pull a cotangent of scales back to their logarithms: `v_log_scales = exp(log_scales) v_scales`.

    Source: transpose of `scales_from_log_scales`.
    Departs: nothing.

    Args:
        log_scales: natural logarithms of standard deviations in world units.
        v_scales: cotangent of the standard deviations.

    Returns:
        Cotangent of `log_scales`.

    Example:
        >>> scales_from_log_scales_vjp(np.log([[1.0, 2.0, 4.0]]), np.ones((1, 3)))
        array([[1., 2., 4.]])
    """
    return np.exp(log_scales) * v_scales


def opacities_from_logits(logit_opacities: Float64[np.ndarray, " N"]) -> Float64[np.ndarray, " N"]:
    """Make opacities in (0, 1): `o = 1 / (1 + exp(-logit))`, without overflow at either end.

    Source: Kerbl et al. 2023 (3DGS), section 5.1; POP paper, section 3.1.
    Departs: nothing.

    Args:
        logit_opacities: unbounded, 1.

    Returns:
        Opacities, 1. They round to exactly 0 or 1 far out (logit under -746, over 37).

    Example:
        >>> opacities_from_logits(np.array([0.0, -1000.0, 1000.0]))
        array([0.5, 0. , 1. ])
    """
    opacities = np.zeros(logit_opacities.shape)
    for i, logit in enumerate(logit_opacities.tolist()):
        # the exponent is never positive, so that exp cannot overflow
        fall = math.exp(-abs(logit))
        opacities[i] = (1.0 if logit >= 0.0 else fall) / (1.0 + fall)
    return opacities


def opacities_from_logits_vjp(
    logit_opacities: Float64[np.ndarray, " N"], v_opacities: Float64[np.ndarray, " N"]
) -> Float64[np.ndarray, " N"]:
    """Pull a cotangent of opacities back to logits: `v_logit = o (1 - o) v_o`.

    Source: transpose of `opacities_from_logits`.
    Departs: nothing.

    Args:
        logit_opacities: unbounded, 1.
        v_opacities: cotangent of the opacities.

    Returns:
        Cotangent of `logit_opacities`.

    Example:
        >>> opacities_from_logits_vjp(np.array([0.0]), np.array([8.0]))
        array([2.])
    """
    # 1 - o is the opacity of the negated logit: no cancellation where o is near 1
    return opacities_from_logits(logit_opacities) * opacities_from_logits(-logit_opacities) * v_opacities


def unit_quats_from_quats(quats: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Divide quaternions by their norm: `unit = q / |q|`.

    Source: Kerbl et al. 2023 (3DGS), section 4.
    Departs: gsplat adds no epsilon, torch.nn.functional.normalize (Inria) divides by max(|q|, 1e-12).

    Args:
        quats: wxyz, any norm > 0.

    Returns:
        Unit quaternions, wxyz.

    Example:
        >>> unit_quats_from_quats(np.array([[0.0, 0.0, -4.0, 0.0]]))
        array([[ 0.,  0., -1.,  0.]])
    """
    units = np.zeros(quats.shape)
    for i in range(len(quats)):
        units[i] = quats[i] / math.hypot(*quats[i].tolist())
    return units


def unit_quats_from_quats_vjp(
    quats: Float64[np.ndarray, "N 4"], v_unit_quats: Float64[np.ndarray, "N 4"]
) -> Float64[np.ndarray, "N 4"]:
    """Pull a cotangent of unit quaternions back: `v_q = (v_u - u (u . v_u)) / |q|`, orthogonal to q.

    Source: transpose of `unit_quats_from_quats`.
    Departs: nothing.

    Args:
        quats: wxyz, any norm > 0.
        v_unit_quats: cotangent of the unit quaternions.

    Returns:
        Cotangent of `quats`.

    Example:
        >>> unit_quats_from_quats_vjp(np.array([[2.0, 0.0, 0.0, 0.0]]), np.array([[8.0, 4.0, 2.0, 0.0]]))
        array([[0., 2., 1., 0.]])
    """
    v_quats = np.zeros(quats.shape)
    units = unit_quats_from_quats(quats)
    for i in range(len(quats)):
        u, v_u = units[i], v_unit_quats[i]
        v_quats[i] = (v_u - u * (u @ v_u)) / math.hypot(*quats[i].tolist())
    return v_quats
