"""Raw parameters -> scales, opacities, unit quaternions -> covariances. See `pop_ref.covariance`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.types import columns, from_columns, sum_of_products


def scales_from_log_scales(log_scales: Tensor) -> Tensor:
    """See `pop_ref.activations.scales_from_log_scales`."""
    return torch.exp(log_scales)


def scales_from_log_scales_vjp(log_scales: Tensor, v_scales: Tensor) -> Tensor:
    """See `pop_ref.activations.scales_from_log_scales_vjp`."""
    return torch.exp(log_scales) * v_scales


def opacities_from_logits(logit_opacities: Tensor) -> Tensor:
    """See `pop_ref.activations.opacities_from_logits`.

    Differentiable; its slope is that of `opacities_from_logits_vjp`, where torch's own sigmoid has none in float32 from
    logits of 17 on, so that an opacity which came there could not leave again.
    """
    return _Opacities.apply(logit_opacities)


def opacities_from_logits_vjp(logit_opacities: Tensor, v_opacities: Tensor) -> Tensor:
    """See `pop_ref.activations.opacities_from_logits_vjp`."""
    # 1 - o is the opacity of the negated logit: no cancellation where o is near 1
    return torch.sigmoid(logit_opacities) * torch.sigmoid(-logit_opacities) * v_opacities


class _Opacities(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, logit_opacities: Tensor) -> Tensor:
        context.save_for_backward(logit_opacities)
        return torch.sigmoid(logit_opacities)

    @staticmethod
    def backward(context: Any, v_opacities: Tensor) -> Tensor:
        (logit_opacities,) = context.saved_tensors
        return opacities_from_logits_vjp(logit_opacities, v_opacities)


def unit_quats_from_quats(quats: Tensor) -> Tensor:
    """See `pop_ref.activations.unit_quats_from_quats`."""
    return from_columns(_unit_columns(quats)[0], (4,))


def unit_quats_from_quats_vjp(quats: Tensor, v_unit_quats: Tensor) -> Tensor:
    """See `pop_ref.activations.unit_quats_from_quats_vjp`."""
    unit, norms = _unit_columns(quats)
    return _along_the_sphere(unit, norms, columns(v_unit_quats))


def rotmats_from_quats(quats: Tensor) -> Tensor:
    """See `pop_ref.covariance.rotmats_from_quats`. Optimizations: nine component rows instead of N small matrices."""
    return from_columns(_rotation_entries(*_unit_columns(quats)[0]), (3, 3))


def rotmats_from_quats_vjp(quats: Tensor, v_rotmats: Tensor) -> Tensor:
    """See `pop_ref.covariance.rotmats_from_quats_vjp`. Optimizations: component rows."""
    return _quats_vjp(*_unit_columns(quats), columns(v_rotmats))


def covars_from_quats_scales(quats: Tensor, scales: Tensor) -> Tensor:
    """See `pop_ref.covariance.covars_from_quats_scales`.

    Optimizations: component rows; the six distinct entries are computed once and mirrored.
    """
    m = _scaled_rotation(_rotation_entries(*_unit_columns(quats)[0]), scales)
    xx, xy, xz = _dot(m, 0, 0), _dot(m, 0, 1), _dot(m, 0, 2)
    yy, yz, zz = _dot(m, 1, 1), _dot(m, 1, 2), _dot(m, 2, 2)
    return from_columns((xx, xy, xz, xy, yy, yz, xz, yz, zz), (3, 3))


def covars_from_quats_scales_vjp(quats: Tensor, scales: Tensor, v_covars: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.covariance.covars_from_quats_scales_vjp`. Optimizations: component rows."""
    unit, norms = _unit_columns(quats)
    r = _rotation_entries(*unit)
    m = _scaled_rotation(r, scales)
    v = columns(v_covars)
    d = (v[0] + v[0], v[1] + v[3], v[2] + v[6], v[4] + v[4], v[5] + v[7], v[8] + v[8])
    symmetric = ((d[0], d[1], d[2]), (d[1], d[3], d[4]), (d[2], d[4], d[5]))
    v_m = [[sum_of_products(symmetric[i], (m[j], m[3 + j], m[6 + j])) for j in range(3)] for i in range(3)]
    s = columns(scales)
    v_r = tuple(v_m[i][j] * s[j] for i in range(3) for j in range(3))
    v_scales = [sum_of_products((r[j], r[3 + j], r[6 + j]), (v_m[0][j], v_m[1][j], v_m[2][j])) for j in range(3)]
    return _quats_vjp(unit, norms, v_r), from_columns(v_scales, (3,))


def _unit_columns(quats: Tensor) -> tuple[tuple[Tensor, ...], Tensor]:
    # divided by the largest entry first: squares of no quaternion overflow or vanish
    largest = quats.abs().amax(-1)
    w, x, y, z = (c / largest for c in columns(quats))
    length = torch.sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length), largest * length


def _rotation_entries(w: Tensor, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, ...]:
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


def _scaled_rotation(r: tuple[Tensor, ...], scales: Tensor) -> tuple[Tensor, ...]:
    s = columns(scales)
    return tuple(r[3 * i + j] * s[j] for i in range(3) for j in range(3))


def _dot(m: tuple[Tensor, ...], i: int, j: int) -> Tensor:
    return sum_of_products(m[3 * i : 3 * i + 3], m[3 * j : 3 * j + 3])


def _quats_vjp(unit: tuple[Tensor, ...], norms: Tensor, v: tuple[Tensor, ...]) -> Tensor:
    w, x, y, z = unit
    v_w = 2.0 * (x * (v[7] - v[5]) + y * (v[2] - v[6]) + z * (v[3] - v[1]))
    v_x = 2.0 * (w * (v[7] - v[5]) + y * (v[1] + v[3]) + z * (v[2] + v[6]) - 2.0 * x * (v[4] + v[8]))
    v_y = 2.0 * (w * (v[2] - v[6]) + x * (v[1] + v[3]) + z * (v[5] + v[7]) - 2.0 * y * (v[0] + v[8]))
    v_z = 2.0 * (w * (v[3] - v[1]) + x * (v[2] + v[6]) + y * (v[5] + v[7]) - 2.0 * z * (v[0] + v[4]))
    return _along_the_sphere(unit, norms, (v_w, v_x, v_y, v_z))


def _along_the_sphere(unit: tuple[Tensor, ...], norms: Tensor, v_unit: tuple[Tensor, ...]) -> Tensor:
    along = sum_of_products(unit, v_unit)
    # the norm of a quaternion has no effect, so its gradient has no part along the quaternion
    return from_columns([(v_c - c * along) / norms for c, v_c in zip(unit, v_unit, strict=True)], (4,))
