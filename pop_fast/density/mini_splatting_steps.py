"""What Mini-Splatting does to the Gaussians beside 3DGS's clone, split and prune."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pop_fast.data.initialize import SH_C0
from pop_fast.density import densify, rows
from pop_fast.density.protocol import DensificationContext, DensificationStep, Params
from pop_fast.stages.mini_splatting import nearest_log_scales, samples_per_view, view_importance
from pop_fast.stages.selection import least_mass, sample_without_replacement

if TYPE_CHECKING:
    from pop_fast.density.mini_splatting import MiniSplattingStrategy


def set_anew_from_depth(plan: MiniSplattingStrategy, context: DensificationContext) -> DensificationStep:
    """Replace all Gaussians by points of the training views, with their pixels' colours."""
    points, colors = [], []
    for index in range(context.views.n_views):
        found, color = _points_of_view(plan, context, index)
        points.append(found)
        colors.append(color)
    sh0 = ((torch.cat(colors) - 0.5) / SH_C0)[:, None]
    return _begin_anew(plan, context, torch.cat(points), sh0)


def _points_of_view(plan: MiniSplattingStrategy, context: DensificationContext, index: int) -> tuple[Tensor, Tensor]:
    """Draw pixels by their opacity, and return their points and their photograph's colours. [M, 3] each"""
    views = context.views
    points, ids, T_final = views.dominant_points(context.params, index, context.sh_degree)
    height, width = ids.shape
    mask = views.view(index).mask
    shown = ids >= 0 if mask is None else (ids >= 0) & mask.to(ids.device)
    weights = torch.where(shown, 1.0 - T_final, 0.0).flatten().to("cpu", torch.float64)
    wanted = samples_per_view(views.n_views, width, height, plan.reinit_points)
    wanted = min(wanted, int((weights > 0.0).sum()))
    drawn = sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights))).to(points.device)
    photo = views.photo(index).reshape(-1, 3).to(points.device)
    return points.reshape(-1, 3)[drawn], photo[drawn].to(points.dtype) / 255.0


def importance(plan: MiniSplattingStrategy, context: DensificationContext) -> Tensor:
    """Sum the importance of every Gaussian over the training views; 0 where none is dominated at any pixel. [N]"""
    n = len(context)
    total, dominant_sum = torch.zeros(n, dtype=torch.float64), torch.zeros(n, dtype=torch.int64)
    for index in range(context.views.n_views):
        found = context.views.contributions(context.params, index, context.sh_degree)
        total += view_importance(found, found.dominant_counts, plan.importance == "outdoor").to("cpu", torch.float64)
        dominant_sum += found.dominant_counts.cpu()
    return torch.where(dominant_sum > 0, total, 0.0)


def draw_by_importance(plan: MiniSplattingStrategy, context: DensificationContext) -> DensificationStep:
    """Let a share of the Gaussians, drawn by importance, keep place and colour and begin anew; the others go."""
    weights = importance(plan, context)
    wanted = int(plan.sampling_factor * int((weights > 0.0).sum()))
    drawn = sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))
    drawn = drawn.to(context.params["means"].device)
    return _begin_anew(plan, context, context.params["means"].detach()[drawn], context.params["sh0"].detach()[drawn])


def prune(plan: MiniSplattingStrategy, context: DensificationContext) -> DensificationStep:
    """Remove the least important Gaussians, and start Adam anew."""
    mask = least_mass(importance(plan, context), plan.prune_mass)
    pruned = densify.prune(context, mask.to(context.params["means"].device))
    rows.restart(context.params, context.optimizers)
    return DensificationStep(pruned=pruned)


def _begin_anew(
    plan: MiniSplattingStrategy, context: DensificationContext, points: Tensor, sh0: Tensor
) -> DensificationStep:
    densify.forget(context.state)
    rows.replace_rows(
        context.params, context.optimizers, context.state, _rows(context.params, points, sh0, plan.reinit_opacity)
    )
    return DensificationStep(replaced=len(points))


def _rows(params: Params, points: Tensor, sh0: Tensor, opacity: float) -> Mapping[str, Tensor]:
    """Make raw parameters of points: spheres as large as the way to their neighbours, bands beyond the first 0."""
    n = len(points)
    upright = points.new_zeros((n, 4))
    upright[:, 0] = 1.0
    return {
        "means": points,
        "scales": nearest_log_scales(points).to(points),
        "quats": upright,
        "opacities": torch.logit(points.new_full((n,), opacity)),
        "sh0": sh0.to(points),
        "shN": points.new_zeros((n, *params["shN"].shape[1:])),
    }
