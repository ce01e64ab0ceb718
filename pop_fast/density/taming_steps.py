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


def refine(plan: TamingStrategy, of: DensificationContext) -> DensificationStep:
    """Clone, split and prune, each by sampling."""
    scores, nth = scores_of(plan, of), plan.densification_at(of.step)
    clones, splits = densify.who_grows(plan, of)
    budget = budget_at(nth, plan.n_densifications, of.state["first_count"], plan.target(of.state["first_count"]))
    n_clone, n_split = quotas(budget, len(of), int(clones.sum()), int(splits.sum()))
    clones, splits = _drawn(clones, scores, n_clone, of), _drawn(splits, scores, n_split, of)
    # after the split its parents' rows are gone
    inverse = 1.0 / (1e-6 + scores)
    weights = inverse if plan.misaligned_prune_weights else inverse[~splits.cpu()]

    def who_goes() -> Tensor:
        mask = densify.who_goes(plan, of)
        return torch.zeros_like(mask) if nth > plan.sampled_prunes else mask & _drawn_to_go(mask, weights, of)

    return densify.refine(plan, of, clones, splits, who_goes)


def scores_of(plan: TamingStrategy, of: DensificationContext) -> Tensor:
    """Score the Gaussians by a few training views. [N] float64, on the CPU"""
    views, params = of.views, of.params
    order = torch.argsort(of.draws.uniforms(views.n_views))[: plan.score_views].tolist()
    grads = average_grads(densify.window(of.state), plan)
    opacities, scales = torch.sigmoid(params["opacities"].flatten()), torch.exp(params["scales"])
    total = torch.zeros(len(of), dtype=torch.float64)
    for index in order:
        photo = views.photo(index)
        found = views.contributions(params, index, of.sh_degree, lambda image, photo=photo: pixel_weights(image, photo))
        target = photo.to(found.image.dtype) / 255.0
        photometric = photometric_3dgs(found.image, target, padding="same")
        total += view_score(photometric, grads, opacities, scales, found.depths, found.radii, found).cpu()
    return total


def _drawn(candidates: Tensor, scores: Tensor, wanted: int, of: DensificationContext) -> Tensor:
    """Draw so many candidates by score. [N] bool"""
    weights = torch.where(candidates.cpu(), scores, 0.0)
    wanted = min(wanted, int((weights > 0.0).sum()))
    mask = torch.zeros(len(weights), dtype=torch.bool)
    mask[sample_without_replacement(weights, wanted, of.draws.uniforms(len(weights)))] = True
    return mask.to(candidates.device)


def _drawn_to_go(mask: Tensor, weights: Tensor, of: DensificationContext) -> Tensor:
    """Draw half as many as may go, by the weights of the first rows; the others, which are new, stay. [N] bool"""
    of_all = weights.new_zeros(len(mask))
    of_all[: len(weights)] = weights[: len(mask)]
    wanted = min(int(mask.sum()) // 2, int((of_all > 0.0).sum()))
    drawn = torch.zeros(len(mask), dtype=torch.bool)
    drawn[sample_without_replacement(of_all, wanted, of.draws.uniforms(len(mask)))] = True
    return drawn.to(mask.device)
