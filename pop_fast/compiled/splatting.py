"""Covariances, projection and colours by the compiled library. Meaning: `pop_ref.splatting`.

The arithmetic of one Gaussian is the one that the CUDA kernels run (`cuda_ext/csrc/splatting.cuh`, `harmonics.cuh`).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.compiled.library import (
    PROJECTION_CONSTANTS,
    Colors,
    ColorsBackward,
    Covariances,
    CovariancesBackward,
    Projection,
    ProjectionBackward,
    call_library,
    this_library,
)
from pop_fast.stages.projection import view_dirs_vjp
from pop_fast.stages.splatting import ProjectionSettings, Splats


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """See `pop_fast.stages.splatting.covariances`."""
    return _Covariances.apply(quats, scales)


def project(means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings) -> Splats:
    """See `pop_fast.stages.splatting.project`; rows of culled Gaussians hold 0, but for depths and opacities.

    Optimizations: one pass over the Gaussians forward and one backward, which compute everything in between anew.
    """
    return Splats(*_Projection.apply(means, covars, opacities, viewmat, view))


def colors_of_view(sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
    """Evaluate harmonics for the visible Gaussians; zero for the others. [N, 3]

    Optimizations: one pass over the coefficients forward and one backward (`colors.h`).

    Args:
        sh: coefficients. [N, n_sh, 3]
        means: centres, world units. [N, 3]
        viewmat: world -> camera. [4, 4]
        degree: bands to use.
        visible: rows to evaluate, ascending. [V] int64

    Raises:
        ValueError: `visible` is no list of rows.
    """
    if visible.dtype != torch.int64 or visible.dim() != 1:
        shape = list(visible.shape)
        raise ValueError(
            f"visible is a tensor of {visible.dtype} and shape {shape}; it must hold the numbers of the rows to "
            "evaluate, torch.int64 [V]; of a mask these are mask.nonzero().squeeze(1)"
        )
    if len(visible) and not (int(visible.min()) >= 0 and int(visible.max()) < len(sh)):
        raise ValueError(f"visible names row {int(visible.min())} to {int(visible.max())}; there are {len(sh)}")
    return _Colors.apply(sh, means, viewmat, degree, visible)


class _Covariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, scales: Tensor) -> Tensor:
        covars = quats.new_empty((len(quats), 3, 3))
        given = {"quats": quats, "scales": scales, "covars": covars}
        call_library(Covariances, quats.dtype, {"n": len(quats), "threads": torch.get_num_threads()}, given)
        ctx.save_for_backward(quats, scales)
        return covars

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_covars: Tensor) -> tuple[Tensor, Tensor]:
        quats, scales = ctx.saved_tensors
        v_quats, v_scales = quats.new_empty(quats.shape), scales.new_empty(scales.shape)
        given = {"quats": quats, "scales": scales, "v_covars": v_covars, "v_quats": v_quats, "v_scales": v_scales}
        call_library(CovariancesBackward, quats.dtype, {"n": len(quats), "threads": torch.get_num_threads()}, given)
        return v_quats, v_scales


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings
    ) -> tuple[Tensor | None, ...]:
        n = len(means)
        results = {
            "means2d": means.new_empty((n, 2)),
            "depths": means.new_empty(n),
            "conics": means.new_empty((n, 3)),
            "effective_opacities": means.new_empty(n),
            "radii": torch.empty((n, 2), dtype=torch.int32),
            "factors": means.new_empty(n) if view.antialiased else None,
        }
        given = {"means": means, "covars": covars, "opacities": opacities, "viewmat": viewmat, "K": view.K}
        call_library(Projection, means.dtype, _projection_numbers(n, view), {**given, **results})
        ctx.view, ctx.radii = view, results["radii"]
        ctx.save_for_backward(means, covars, opacities, viewmat)
        ctx.mark_non_differentiable(results["radii"])
        return tuple(results.values())

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        v_means2d: Tensor,
        v_depths: Tensor,
        v_conics: Tensor,
        v_effective_opacities: Tensor,
        _v_radii: None,
        v_factors: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        means, covars, opacities, viewmat = ctx.saved_tensors
        n_parts = -(-len(means) // this_library().rows_at_a_time)
        found = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in (means, covars, opacities)]
        v_viewmats = means.new_empty((n_parts, 3, 4)) if ctx.needs_input_grad[3] else None
        given = {"means": means, "covars": covars, "opacities": opacities, "viewmat": viewmat, "K": ctx.view.K}
        given |= {
            "v_means2d": v_means2d.T,
            "v_depths": v_depths,
            "v_conics": v_conics.T,
            "v_effective_opacities": v_effective_opacities,
        }
        given |= {"v_factors": v_factors, "radii": ctx.radii, "v_viewmats": v_viewmats}
        given |= dict(zip(("v_means", "v_covars", "v_opacities"), found, strict=True))
        call_library(ProjectionBackward, means.dtype, _projection_numbers(len(means), ctx.view), given)
        if v_viewmats is None:
            return (*found, None, None)
        v_viewmat = torch.zeros_like(viewmat)
        v_viewmat[:3] = v_viewmats.sum(0, dtype=torch.float64)
        return (*found, v_viewmat, None)


def _projection_numbers(n: int, view: ProjectionSettings) -> dict[str, float]:
    constants = view.profile.as_numbers()
    return {
        **{name: constants[name] for name in (*PROJECTION_CONSTANTS, "tile_size")},
        "antialiased": view.antialiased,
        "radius_clip": view.radius_clip,
        "width": view.width,
        "height": view.height,
        "n": n,
        "threads": torch.get_num_threads(),
    }


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
        colors = sh.new_empty((3, len(sh)))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible, "colors": colors}
        call_library(Colors, sh.dtype, _numbers(sh, degree, visible), given)
        ctx.degree = degree
        ctx.save_for_backward(sh, means, viewmat, visible)
        return colors.T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        sh, means, viewmat, visible = ctx.saved_tensors
        v_sh, v_dirs = torch.empty_like(sh, memory_format=torch.contiguous_format), sh.new_empty((len(sh), 3))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible}
        given |= {"v_colors": v_colors, "v_sh": v_sh, "v_dirs": v_dirs}
        call_library(ColorsBackward, sh.dtype, _numbers(sh, ctx.degree, visible), given)
        if not ctx.needs_input_grad[2]:
            return v_sh, v_dirs, None, None, None
        _, v_viewmat = view_dirs_vjp(means.index_select(0, visible), viewmat, v_dirs.index_select(0, visible))
        return v_sh, v_dirs, v_viewmat, None, None


def _numbers(sh: Tensor, degree: int, visible: Tensor) -> dict[str, float]:
    sizes = {"n": len(sh), "n_visible": len(visible), "n_sh": sh.shape[1]}
    return {**sizes, "degree": degree, "threads": torch.get_num_threads()}
