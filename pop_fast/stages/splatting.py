"""Gaussians as one camera sees them, differentiably. Meaning: `pop_ref.splatting`.

Each autograd function here is a chain of the stage functions forward and of their transposes backward: no graph is
recorded for the hundred elementwise operations in between.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pop_fast.stages.covariance import covars_from_quats_scales, covars_from_quats_scales_vjp
from pop_fast.stages.harmonics import evaluate_sh, evaluate_sh_vjp
from pop_fast.stages.projection import (
    compensations,
    compensations_vjp,
    conics_from_covars2d,
    conics_from_covars2d_vjp,
    covars_cam_from_covars,
    covars_cam_from_covars_vjp,
    in_front,
    low_pass,
    low_pass_vjp,
    means_cam_from_means,
    means_cam_from_means_vjp,
    on_screen,
    project_covars,
    project_covars_vjp,
    project_means,
    project_means_vjp,
    projection_jacobians,
    projection_jacobians_vjp,
    radii_from_covars2d,
    view_dirs,
    view_dirs_vjp,
)
from pop_fast.stages.types import full_precision_backward
from pop_ref.constants import PAPER, Profile


@dataclass(frozen=True)
class Splats:
    """Gaussians as one camera sees them, one row each; see `pop_ref.records.Splats`."""

    means2d: Tensor  # screen centres, px. [N, 2]
    depths: Tensor  # camera z, world units. [N]
    conics: Tensor  # inverse screen covariances (xx, xy, yy), px^-2. [N, 3]
    opacities: Tensor  # what blends, after the antialiasing factor if any. [N]
    radii: Tensor  # extents in px; both 0 where culled. [N, 2] int32
    compensations: Tensor | None = None  # the antialiasing factor, None in classic mode. [N]
    colors: Tensor | None = None  # any number of channels, where what takes the splats reads them. [N, D]


class Shapes(NamedTuple):
    """Rotations [N, 4] and sizes [N, 3] as they are, for backends that make covariances where they project."""

    quats: Tensor
    scales: Tensor


def colors_of(splats: Splats) -> Tensor:
    """Return the colours of splats; ValueError where they have none. [N, D]"""
    if splats.colors is None:
        raise ValueError("the splats have no colours")
    return splats.colors


@dataclass(frozen=True)
class ProjectionSettings:
    """What a projection needs of a camera."""

    K: Tensor  # intrinsics, px. [3, 3]
    width: int  # px
    height: int  # px
    profile: Profile = PAPER  # near and far plane, clamp, low-pass, extents
    antialiased: bool = False  # scale opacities by the antialiasing factor
    radius_clip: float = 0.0  # px; splats whose two extents are both at most this are culled


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Return covariances [N, 3, 3] from quaternions and scales, differentiably."""
    return _Covariances.apply(quats, scales)  # type: ignore[no-any-return]


def project(means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings) -> Splats:
    """Project Gaussians; see `pop_ref.splatting.project`. Everything but `radii` is differentiable.

    Args:
        covars: covariances, world units^2. [N, 3, 3]
        view: the rest of the camera.
    """
    means2d, depths, conics, effective_opacities, radii, factors = _Projection.apply(
        means, covars, opacities, viewmat, view
    )
    return Splats(means2d, depths, conics, effective_opacities, radii, factors if view.antialiased else None)


def colors_of_view(sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
    """Evaluate harmonics for the visible Gaussians; zero for the others. [N, 3]

    Args:
        sh: coefficients. [N, n_sh, 3]
        means: centres, world units. [N, 3]
        viewmat: world -> camera. [4, 4]
        degree: bands to use.
        visible: rows to evaluate. [V] int64
    """
    return _Colors.apply(sh, means, viewmat, degree, visible)  # type: ignore[no-any-return]


class _Covariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, scales: Tensor) -> Tensor:
        ctx.save_for_backward(quats, scales)
        return covars_from_quats_scales(quats, scales)

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_covars: Tensor) -> tuple[Tensor, Tensor]:
        quats, scales = ctx.saved_tensors
        return covars_from_quats_scales_vjp(quats, scales, v_covars)


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings
    ) -> tuple[Tensor, ...]:
        camera = (view.K, view.width, view.height)
        profile = view.profile
        means_cam = means_cam_from_means(means, viewmat)
        depths = means_cam[:, 2]
        front = in_front(depths, profile)
        # rows behind the camera go through as a harmless point, so that no branch is needed until the cull
        safe = means_cam.T.clone()
        safe[2] = torch.where(front, depths, 1.0)
        covars_cam = covars_cam_from_covars(covars, viewmat)
        jacobians = projection_jacobians(safe.T, *camera, profile)
        covars2d = project_covars(covars_cam, jacobians)
        blurred = low_pass(covars2d, profile.eps2d)
        factors = compensations(covars2d, profile.eps2d) if view.antialiased else torch.ones_like(depths)
        effective_opacities = opacities * factors if view.antialiased else opacities.clone()
        means2d = project_means(safe.T, *camera, profile)
        radii = radii_from_covars2d(blurred, effective_opacities, profile)
        shown = front & on_screen(means2d, radii, view.width, view.height, profile)
        shown &= (radii > view.radius_clip).any(1)
        radii = torch.where(shown, radii.T, 0).T
        ctx.view = view
        ctx.save_for_backward(means, covars, opacities, viewmat, safe, covars_cam, jacobians, covars2d, blurred, shown)
        ctx.mark_non_differentiable(radii)
        # what has overflowed of a row that is culled is no number, which times nothing is none either
        conics = torch.where(shown, conics_from_covars2d(blurred).T, 0.0).T
        return means2d, depths.clone(), conics, effective_opacities, radii, factors

    @staticmethod
    @full_precision_backward
    def backward(
        ctx: Any,
        v_means2d: Tensor,
        v_depths: Tensor,
        v_conics: Tensor,
        v_effective_opacities: Tensor,
        _v_radii: Tensor,
        v_factors: Tensor,
    ) -> tuple[Tensor | None, ...]:
        means, covars, opacities, viewmat, safe, covars_cam, jacobians, covars2d, blurred, shown = ctx.saved_tensors
        view: ProjectionSettings = ctx.view
        camera, eps2d = (view.K, view.width, view.height), view.profile.eps2d
        v_covars2d = low_pass_vjp(covars2d, eps2d, conics_from_covars2d_vjp(blurred, v_conics))
        v_opacities = v_effective_opacities
        if view.antialiased:
            v_opacities = v_effective_opacities * compensations(covars2d, eps2d)
            v_covars2d = v_covars2d + compensations_vjp(covars2d, eps2d, v_effective_opacities * opacities + v_factors)
        v_covars_cam, v_jacobians = project_covars_vjp(covars_cam, jacobians, v_covars2d)
        v_means_cam = projection_jacobians_vjp(safe.T, *camera, v_jacobians, view.profile)
        v_means_cam = v_means_cam + project_means_vjp(safe.T, *camera, v_means2d, view.profile)
        v_means_cam[:, 2] += v_depths
        # culled rows get exact zeros, whatever overflowed on the way
        v_means_cam = torch.where(shown, v_means_cam.T, 0.0).T
        v_covars_cam = torch.where(shown, v_covars_cam.permute(1, 2, 0), 0.0).permute(2, 0, 1)
        needs_viewmat = ctx.needs_input_grad[3]
        if needs_viewmat:  # likewise
            covars = torch.where(shown, covars.permute(1, 2, 0), 0.0).permute(2, 0, 1)
        v_covars, v_viewmat = covars_cam_from_covars_vjp(covars, viewmat, v_covars_cam, needs_viewmat)
        v_means, v_viewmat_of_means = means_cam_from_means_vjp(means, viewmat, v_means_cam)
        v_viewmat = v_viewmat + v_viewmat_of_means if needs_viewmat else None
        return v_means, v_covars, torch.where(shown, v_opacities, 0.0), v_viewmat, None


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
        chosen = means.index_select(0, visible)
        dirs = view_dirs(chosen, viewmat)
        evaluation = evaluate_sh(sh.index_select(0, visible), dirs, degree)
        ctx.save_for_backward(sh, means, viewmat, visible)
        ctx.chosen, ctx.evaluation = chosen, evaluation
        colors = sh.new_zeros((3, len(sh)))
        colors[:, visible] = evaluation.unclamped.clamp_min(0.0)
        return colors.T

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        sh, means, viewmat, visible = ctx.saved_tensors
        v_sh_rows, v_dirs = evaluate_sh_vjp(ctx.evaluation, v_colors.T.index_select(1, visible))
        v_rows, v_viewmat = view_dirs_vjp(ctx.chosen, viewmat, v_dirs)
        v_sh = torch.zeros_like(sh, memory_format=torch.contiguous_format)
        v_sh[:, : v_sh_rows.shape[1]].index_copy_(0, visible, v_sh_rows.contiguous())
        v_means = torch.zeros_like(means).index_copy_(0, visible, v_rows)
        return v_sh, v_means, v_viewmat if ctx.needs_input_grad[2] else None, None, None
