"""World -> camera, and the near-plane cull (D1). Meaning: `pop_ref.camera`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.layout import columns
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
    """See `pop_ref.camera.means_cam_from_means`. Optimizations: one matrix product, component-major result."""
    return torch.addmm(viewmat[:3, 3:], viewmat[:3, :3], means.T).T


def means_cam_from_means_vjp(means: Tensor, viewmat: Tensor, v_means_cam: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.means_cam_from_means_vjp`. Optimizations: matrix products."""
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = v_means_cam.T @ means
    v_viewmat[:3, 3] = v_means_cam.sum(0)
    return (viewmat[:3, :3].T @ v_means_cam.T).T, v_viewmat


def covars_cam_from_covars(covars: Tensor, viewmat: Tensor) -> Tensor:
    """See `pop_ref.camera.covars_cam_from_covars`.

    Optimizations: R Sigma R^T is linear in Sigma, so all N are one product with the 9x9 Kronecker square of R.
    """
    return _flat_product(_kron_square(viewmat), covars)


def covars_cam_from_covars_vjp(
    covars: Tensor, viewmat: Tensor, v_covars_cam: Tensor, with_viewmat: bool = True
) -> tuple[Tensor, Tensor]:
    """See `pop_ref.camera.covars_cam_from_covars_vjp`.

    Optimizations: the same 9x9 product, transposed; the gradient to the camera, which training does not need, can be
    left out (zeros then).
    """
    v_covars = _flat_product(_kron_square(viewmat).T, v_covars_cam)
    if not with_viewmat:
        return v_covars, torch.zeros_like(viewmat)
    symmetric = v_covars_cam + v_covars_cam.transpose(1, 2)
    rotated = torch.matmul(viewmat[:3, :3], covars)
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3, :3] = torch.einsum("nij,njk->ik", symmetric, rotated)
    return v_covars, v_viewmat


def in_front(depths: Tensor, profile: Profile = PAPER) -> Tensor:
    """See `pop_ref.camera.in_front` (D1). Optimizations: none."""
    near = depths > profile.near_plane if profile.near_inclusive else depths >= profile.near_plane
    return near & (depths <= profile.far_plane)


def _kron_square(viewmat: Tensor) -> Tensor:
    R = viewmat[:3, :3].contiguous()
    return torch.kron(R, R)


def _flat_product(matrix: Tensor, covars: Tensor) -> Tensor:
    flat = torch.stack(columns(covars))
    return (matrix @ flat).reshape(3, 3, len(covars)).permute(2, 0, 1)
