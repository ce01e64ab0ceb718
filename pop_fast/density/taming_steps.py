"""What Taming-3DGS does at a densification step: score, draw who grows, draw who goes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pop_fast.density import densify
from pop_fast.density.protocol import DensificationContext, DensificationStep
from pop_fast.stages.density import average_grads
from pop_fast.stages.losses import photometric_3dgs
from pop_fast.stages.selection import sample_without_replacement
from pop_fast.stages.taming import budget_at, pixel_weights, quotas, view_score

if TYPE_CHECKING:
    from pop_fast.density.taming import TamingStrategy


def refine(plan: TamingStrategy, context: DensificationContext) -> DensificationStep:
    """Clone, split and prune, each by sampling."""
    scores, nth = scores_of(plan, context), plan.densification_at(context.step)
    clones, splits = densify.planned_growth(plan, context)
    budget = budget_at(
        nth, plan.n_densifications, context.state["first_count"], plan.target(context.state["first_count"])
    )
    n_clone, n_split = quotas(budget, len(context), int(clones.sum()), int(splits.sum()))
    clones, splits = _drawn(clones, scores, n_clone, context), _drawn(splits, scores, n_split, context)
    # after the split its parents' rows are gone
    inverse = 1.0 / (1e-6 + scores)
    weights = inverse if plan.misaligned_prune_weights else inverse[~splits.cpu()]

    def planned_prune() -> Tensor:
        mask = densify.planned_prune(plan, context)
        return torch.zeros_like(mask) if nth > plan.sampled_prunes else mask & _drawn_to_go(mask, weights, context)

    return densify.refine(plan, context, clones, splits, planned_prune)


def scores_of(plan: TamingStrategy, context: DensificationContext) -> Tensor:
    """Score the Gaussians by a few training views. [N] float64, on the CPU"""
    views, params = context.views, context.params
    order = torch.argsort(context.draws.uniforms(views.n_views))[: plan.score_views].tolist()
    grads = average_grads(densify.window(context.state), plan)
    opacities, scales = torch.sigmoid(params["opacities"].flatten()), torch.exp(params["scales"])
    total = torch.zeros(len(context), dtype=torch.float64)
    for index in order:
        photo = views.photo(index)
        found = views.contributions(
            params, index, context.sh_degree, lambda image, photo=photo: pixel_weights(image, photo)
        )
        target = photo.to(found.image.dtype) / 255.0
        photometric = photometric_3dgs(found.image, target, padding="same")
        total += view_score(photometric, grads, opacities, scales, found.depths, found.radii, found).cpu()
    return total


def _drawn(candidates: Tensor, scores: Tensor, wanted: int, context: DensificationContext) -> Tensor:
    """Draw so many candidates by score. [N] bool"""
    weights = torch.where(candidates.cpu(), scores, 0.0)
    wanted = min(wanted, int((weights > 0.0).sum()))
    mask = torch.zeros(len(weights), dtype=torch.bool)
    mask[sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))] = True
    return mask.to(candidates.device)


def _drawn_to_go(mask: Tensor, weights: Tensor, context: DensificationContext) -> Tensor:
    """Draw half as many as may go, by the weights of the first rows; the others, which are new, stay. [N] bool"""
    of_all = weights.new_zeros(len(mask))
    of_all[: len(weights)] = weights[: len(mask)]
    wanted = min(int(mask.sum()) // 2, int((of_all > 0.0).sum()))
    drawn = torch.zeros(len(mask), dtype=torch.bool)
    drawn[sample_without_replacement(of_all, wanted, context.draws.uniforms(len(mask)))] = True
    return drawn.to(mask.device)
