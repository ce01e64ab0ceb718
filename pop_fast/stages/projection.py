"""Screen centres, the EWA Jacobian with its frustum clamp (B1), screen covariances. Meaning: `pop_ref.projection`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.layout import columns, from_columns
from pop_ref.constants import PAPER, Profile


def intrinsics(K: Tensor, width: int, height: int, profile: Profile) -> tuple[float, float, float, float]:
    """Return fx, fy and the principal point that the profile uses, px."""
    fx, fy = float(K[0, 0]), float(K[1, 1])
    if profile.principal_point == "centred":
        return fx, fy, 0.5 * width, 0.5 * height
    return fx, fy, float(K[0, 2]), float(K[1, 2])


def project_means(means_cam: Tensor, K: Tensor, width: int, height: int, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.projection.project_means`. Optimizations: component rows."""
    fx, fy, cx, cy = intrinsics(K, width, height, profile)
    x, y, z = columns(means_cam)
    return from_columns((fx * x / z + cx, fy * y / z + cy), (2,))


def project_means_vjp(
    means_cam: Tensor, K: Tensor, width: int, height: int, v_means2d: Tensor, profile: Profile = PAPER
) -> Tensor:
    """See `pop_ref.projection.project_means_vjp`. Optimizations: component rows."""
    fx, fy, _, _ = intrinsics(K, width, height, profile)
    x, y, z = columns(means_cam)
    v_u, v_v = columns(v_means2d)
    v_x, v_y = fx * v_u / z, fy * v_v / z
    return from_columns((v_x, v_y, -(v_x * x + v_y * y) / z), (3,))


def projection_jacobians(means_cam: Tensor, K: Tensor, width: int, height: int, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.projection.projection_jacobians` (B1). Optimizations: component rows."""
    fx, fy, _, _ = intrinsics(K, width, height, profile)
    x, y, z = columns(means_cam)
    (tx, _), (ty, _) = _clamped(x, y, z, K, width, height, profile)
    zero = torch.zeros_like(z)
    return from_columns((fx / z, zero, -fx * tx / (z * z), zero, fy / z, -fy * ty / (z * z)), (2, 3))


def projection_jacobians_vjp(
    means_cam: Tensor, K: Tensor, width: int, height: int, v_jacobians: Tensor, profile: Profile = PAPER
) -> Tensor:
    """See `pop_ref.projection.projection_jacobians_vjp` (B1). Optimizations: component rows, no branches."""
    fx, fy, _, _ = intrinsics(K, width, height, profile)
    x, y, z = columns(means_cam)
    (tx, inside_x), (ty, inside_y) = _clamped(x, y, z, K, width, height, profile)
    v00, _, v02, _, v11, v12 = columns(v_jacobians)
    z2, z3 = z * z, z * z * z
    # where t is clamped it moves with z, which takes one of the two powers of z away; Inria's code keeps both
    powers_x = 2.0 if profile.clamp_gradient == "inria" else 1.0 + inside_x.to(z.dtype)
    powers_y = 2.0 if profile.clamp_gradient == "inria" else 1.0 + inside_y.to(z.dtype)
    v_z = -(fx * v00 + fy * v11) / z2 + (powers_x * fx * tx * v02 + powers_y * fy * ty * v12) / z3
    v_x = -fx * v02 / z2 * inside_x
    v_y = -fy * v12 / z2 * inside_y
    return from_columns((v_x, v_y, v_z), (3,))


def project_covars(covars_cam: Tensor, jacobians: Tensor) -> Tensor:
    """See `pop_ref.projection.project_covars`. Optimizations: component rows; J's two zeros are never multiplied."""
    a, _, b, _, c, d = columns(jacobians)
    xx, xy, xz, _, yy, yz, _, _, zz = columns(covars_cam)
    ax, az = a * xx + b * xz, a * xz + b * zz
    cx, cz = c * xy + d * xz, c * yz + d * zz
    cy = c * yy + d * yz
    off = cx * a + cz * b
    return from_columns((ax * a + az * b, off, off, cy * c + cz * d), (2, 2))


def project_covars_vjp(covars_cam: Tensor, jacobians: Tensor, v_covars2d: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.projection.project_covars_vjp`. Optimizations: component rows."""
    a, _, b, _, c, d = columns(jacobians)
    xx, xy, xz, _, yy, yz, _, _, zz = columns(covars_cam)
    p, q0, q1, s = columns(v_covars2d)
    half = 0.5 * (q0 + q1)
    # J^T V J, with V's off-diagonal split evenly
    v_xx, v_xy = p * a * a, half * a * c
    v_yy = s * c * c
    v_xz = p * a * b + half * a * d
    v_yz = s * c * d + half * b * c
    v_zz = p * b * b + 2.0 * half * b * d + s * d * d
    # (V + V^T) J Sigma
    ax, ay, az = a * xx + b * xz, a * xy + b * yz, a * xz + b * zz
    cx, cy, cz = c * xy + d * xz, c * yy + d * yz, c * yz + d * zz
    v_jacobians = from_columns(
        (
            2.0 * (p * ax + half * cx),
            2.0 * (p * ay + half * cy),
            2.0 * (p * az + half * cz),
            2.0 * (half * ax + s * cx),
            2.0 * (half * ay + s * cy),
            2.0 * (half * az + s * cz),
        ),
        (2, 3),
    )
    return from_columns((v_xx, v_xy, v_xz, v_xy, v_yy, v_yz, v_xz, v_yz, v_zz), (3, 3)), v_jacobians


def _clamped(
    x: Tensor, y: Tensor, z: Tensor, K: Tensor, width: int, height: int, profile: Profile
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return (t, inside) along x and y: t = z * clamp(x / z), inside = it was not clamped."""
    fx, fy, cx, cy = intrinsics(K, width, height, profile)
    return _clamp_one(x, z, fx, cx, width, profile), _clamp_one(y, z, fy, cy, height, profile)


def _clamp_one(x: Tensor, z: Tensor, f: float, c: float, size: int, profile: Profile) -> tuple[Tensor, Tensor]:
    margin = profile.frustum_margin * 0.5 * size / f
    low, high = -(c / f + margin), (size - c) / f + margin
    slope = x / z
    return z * slope.clamp(low, high), (slope >= low) & (slope <= high)
