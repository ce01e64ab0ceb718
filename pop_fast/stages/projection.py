"""From the world to the screen, in the order of a render.

`pop_ref.camera` states world -> camera and the near-plane cull (D1); `pop_ref.projection` screen centres, the EWA
Jacobian with its frustum clamp (B1) and screen covariances; `pop_ref.footprint` the low-pass, the antialiasing factor,
conics, extents and the off-screen cull (D2).
"""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.tiles import tile_rects
from pop_fast.stages.types import columns, from_columns, sum_of_products
from pop_ref.constants import PAPER, Profile


def camera_center(viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.camera_center`."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def view_dirs(means: Tensor, viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.view_dirs`. Optimizations: component-major result."""
    return (means.T - camera_center(viewmat)[:, None]).T


def view_dirs_vjp(means: Tensor, viewmat: Tensor, v_dirs: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.view_dirs_vjp`."""
    v_center = -v_dirs.sum(0)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = -torch.outer(viewmat[:3, 3], v_center)
    v_viewmat[:3, 3] = -viewmat[:3, :3] @ v_center
    return v_dirs, v_viewmat


def means_cam_from_means(means: Tensor, viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.means_cam_from_means`. Optimizations: component rows."""
    xyz, t = columns(means), viewmat[:3, 3]
    return from_columns([sum_of_products(row, xyz) + t[i] for i, row in enumerate(_rotation_rows(viewmat))], (3,))


def means_cam_from_means_vjp(means: Tensor, viewmat: Tensor, v_means_cam: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.means_cam_from_means_vjp`. Optimizations: component rows."""
    v = columns(v_means_cam)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = v_means_cam.T @ means
    v_viewmat[:3, 3] = v_means_cam.sum(0)
    return from_columns([sum_of_products(column, v) for column in _rotation_columns(viewmat)], (3,)), v_viewmat


def covars_cam_from_covars(covars: Tensor, viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.covars_cam_from_covars`.

    Optimizations: component rows; the result's lower triangle mirrors the upper one.
    """
    c = _congruence(_rotation_rows(viewmat), columns(covars))
    return from_columns((c[0], c[1], c[2], c[1], c[4], c[5], c[2], c[5], c[8]), (3, 3))


def covars_cam_from_covars_vjp(
    covars: Tensor, viewmat: Tensor, v_covars_cam: Tensor, with_viewmat: bool = True
) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.covars_cam_from_covars_vjp`.

    Optimizations: component rows; the gradient to the camera, which training does not need, can be left out (zeros
    then).
    """
    v_covars = from_columns(_congruence(_rotation_columns(viewmat), columns(v_covars_cam)), (3, 3))
    v_viewmat = torch.zeros_like(viewmat)
    if with_viewmat:
        rotated = torch.matmul(viewmat[:3, :3], covars)
        v_viewmat[:3, :3] = torch.einsum("nij,njk->ik", v_covars_cam + v_covars_cam.transpose(1, 2), rotated)
    return v_covars, v_viewmat


def in_front(depths: Tensor, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.camera.in_front` (D1)."""
    near = depths > profile.near_plane if profile.near_inclusive else depths >= profile.near_plane
    return near & (depths <= profile.far_plane)


def _rotation_rows(viewmat: Tensor) -> list[tuple[Tensor, ...]]:
    return [row.unbind(0) for row in viewmat[:3, :3].unbind(0)]


def _rotation_columns(viewmat: Tensor) -> list[tuple[Tensor, ...]]:
    return [column.unbind(0) for column in viewmat[:3, :3].unbind(1)]


def _congruence(rows: list[tuple[Tensor, ...]], matrices: tuple[Tensor, ...]) -> list[Tensor]:
    """Return the nine entries of A S A^T for A of the given rows."""
    right = [[sum_of_products(row, matrices[3 * k : 3 * k + 3]) for row in rows] for k in range(3)]
    return [sum_of_products(row, [right[k][j] for k in range(3)]) for row in rows for j in range(3)]


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


def low_pass(covars2d: Tensor, eps2d: float) -> Tensor:
    """See `pop_ref.footprint.low_pass`. Optimizations: component rows."""
    xx, xy, yx, yy = columns(covars2d)
    return from_columns((xx + eps2d, xy, yx, yy + eps2d), (2, 2))


def low_pass_vjp(covars2d: Tensor, eps2d: float, v_blurred: Tensor) -> Tensor:
    """See `pop_ref.footprint.low_pass_vjp`."""
    return v_blurred


def compensations(covars2d: Tensor, eps2d: float) -> Tensor:
    """See `pop_ref.footprint.compensations`. Optimizations: component rows."""
    det, det_blurred = _determinants(covars2d, eps2d)
    return torch.sqrt(torch.clamp_min(det / det_blurred, 0.0))


def compensations_vjp(covars2d: Tensor, eps2d: float, v_factors: Tensor) -> Tensor:
    """See `pop_ref.footprint.compensations_vjp`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    det, det_blurred = _determinants(covars2d, eps2d)
    ratio = det / det_blurred
    # d sqrt(r) = dr / (2 sqrt(r)); where r <= 0 the factor is flat at 0
    slope = torch.where(ratio > 0.0, 0.5 * v_factors / torch.sqrt(ratio.clamp_min(1e-300)), 0.0)
    v_det = slope / det_blurred
    v_det_blurred = -slope * ratio / det_blurred
    v_xx = v_det * yy + v_det_blurred * (yy + eps2d)
    v_yy = v_det * xx + v_det_blurred * (xx + eps2d)
    v_xy = -(v_det + v_det_blurred) * xy
    return from_columns((v_xx, v_xy, v_xy, v_yy), (2, 2))


def conics_from_covars2d(covars2d: Tensor) -> Tensor:
    """See `pop_ref.footprint.conics_from_covars2d`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    inverse = _inverse_det(xx, xy, yy)
    return from_columns((yy * inverse, -xy * inverse, xx * inverse), (3,))


def conics_from_covars2d_vjp(covars2d: Tensor, v_conics: Tensor) -> Tensor:
    """See `pop_ref.footprint.conics_from_covars2d_vjp`. Optimizations: component rows, no branches."""
    xx, xy, _, yy = columns(covars2d)
    inverse = _inverse_det(xx, xy, yy)
    a, b, c = yy * inverse, -xy * inverse, xx * inverse
    v_a, v_b, v_c = columns(v_conics)
    h = 0.5 * v_b
    # the transpose of the inverse is -Q V Q with Q the conic and V the cotangent, its off-diagonal split evenly
    left_xx, left_xy = a * v_a + b * h, a * h + b * v_c
    left_yx, left_yy = b * v_a + c * h, b * h + c * v_c
    v_xy = -(left_xx * b + left_xy * c)
    return from_columns((-(left_xx * a + left_xy * b), v_xy, v_xy, -(left_yx * b + left_yy * c)), (2, 2))


def radii_from_covars2d(covars2d: Tensor, opacities: Tensor, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.footprint.radii_from_covars2d` (D2). Optimizations: component rows, no branches; int32."""
    xx, xy, _, yy = columns(covars2d)
    det = xx * yy - xy * xy
    if profile.extent == "square":
        middle = 0.5 * (xx + yy)
        largest = middle + torch.sqrt(torch.clamp_min(middle * middle - det, 0.1))
        r = torch.ceil(profile.extent_sigmas * torch.sqrt(largest))
        radii, shown = (r, r), det > 0.0
    else:
        # in float32 the ratio is off by its rounding, which just above the floor would round a splat away
        rounding = torch.finfo(torch.float32).eps if opacities.dtype == torch.float32 else 0.0
        reach = torch.sqrt(2.0 * (torch.log(torch.clamp_min(opacities / profile.alpha_floor, 1.0)) + rounding))
        reach = reach.clamp_max(profile.extent_sigmas)
        radii = (torch.ceil(reach * torch.sqrt(xx)), torch.ceil(reach * torch.sqrt(yy)))
        shown = (det > 0.0) & (opacities >= profile.alpha_floor)
    # a splat wider than any image still fits into int32
    return from_columns([torch.where(shown, r, 0.0).clamp_max(1e9).to(torch.int32) for r in radii], (2,))


def on_screen(means2d: Tensor, radii: Tensor, width: int, height: int, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.footprint.on_screen` (D2). Optimizations: component rows."""
    x, y = columns(means2d)
    rx, ry = columns(radii)
    some = (rx > 0) & (ry > 0)
    if profile.extent == "square":
        x0, y0, x1, y1 = columns(tile_rects(means2d, radii, width, height, profile.tile_size, profile))
        return some & (x0 < x1) & (y0 < y1)
    return some & (x + rx > 0) & (x - rx < width) & (y + ry > 0) & (y - ry < height)


def _determinants(covars2d: Tensor, eps2d: float) -> tuple[Tensor, Tensor]:
    xx, xy, _, yy = columns(covars2d)
    return xx * yy - xy * xy, (xx + eps2d) * (yy + eps2d) - xy * xy


def _inverse_det(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    det = xx * yy - xy * xy
    return torch.where(det > 0.0, 1.0 / det, 0.0)
