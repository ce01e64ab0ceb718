"""World -> camera, and the near-plane cull (D1). Meaning: `pop_ref.camera`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.layout import columns, from_columns, sum_of_products
from pop_ref.constants import PAPER, Profile


def camera_center(viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.camera_center`. Optimizations: none."""
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def view_dirs(means: Tensor, viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.view_dirs`. Optimizations: component-major result."""
    return (means.T - camera_center(viewmat)[:, None]).T


def view_dirs_vjp(means: Tensor, viewmat: Tensor, v_dirs: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.view_dirs_vjp`. Optimizations: none."""
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
    """See `pop_ref.camera.in_front` (D1). Optimizations: none."""
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
