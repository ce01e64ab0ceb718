"""Taming-3DGS: growth to a budget, by sampling from a score of nine terms.

Source: Mallick et al. 2024 and its code. Every 500 steps the Gaussians may grow in number, along a parabola from the
first number to the budget (`pop_ref.taming`). Ten training views score each Gaussian by the view's loss times nine
terms; of those that 3DGS would clone or split, as many as the parabola has room for are drawn by score. Of those that
3DGS would prune, only those also drawn go, half as many as there are, by the inverse of the score; the last
densification step prunes nothing. The draw takes the scores in the order from before the split, where they belong to
other Gaussians: a slip of the released code, with which the published numbers were made. The bands beyond the first
move each 16 steps by the sum of their gradients, opacities not at all after step 15,000, where the code hands Adam a
tensor that it does not train. Everything else is 3DGS of 2024, with twice its rate for these bands.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from pop_fast.density.gsplat import InriaStrategy
from pop_fast.density.protocol import DensificationContext, DensificationStep
from pop_ref.recipes import BASELINES, Recipe

if TYPE_CHECKING:
    from torch import Tensor

_TAMING: Final[Recipe] = BASELINES["Taming-3DGS"]


@dataclass(frozen=True, kw_only=True)
class TamingStrategy(InriaStrategy):
    """3DGS with a budget.

    Attributes:
        budget_multiplier: the budget, in first Gaussians: 15 outdoors and 2 indoors of Mip-NeRF 360, 2 on Tanks &
            Temples, 5 on Deep Blending. The paper's count on Mip-NeRF 360 is that of 3 everywhere.
        final_count: the budget itself; 0 takes the multiplier.
        score_views: training views that a densification step scores by.
        sampled_prunes: densification steps, from the first, that prune; the last one of all prunes nothing.
        misaligned_prune_weights: prune by the scores in the order from before the split, as the released
            code does, where they belong to other Gaussians; False draws with those of the Gaussians themselves.
    """

    refine_every: int = _TAMING.density.refine_every
    sh_rest_every: int = _TAMING.updates.sh_rest_every
    opacities_stop_iter: int = _TAMING.updates.opacities_stop_iter
    budget_multiplier: float = 2.0
    final_count: int = 0
    score_views: int = 10
    sampled_prunes: int = 27
    misaligned_prune_weights: bool = True

    def needs_passes(self, step: int) -> bool:
        """Tell whether scores are asked for."""
        return self.is_refine_step(step)

    @property
    def n_densifications(self) -> int:
        """Return in how many steps of the parabola the budget is reached."""
        return (self.refine_stop_iter - self.refine_start_iter) // self.refine_every

    def densification_at(self, step: int) -> int:
        """Return which step of the parabola this is, from 1."""
        return (step - self.refine_start_iter) // self.refine_every

    def refine(self, context: DensificationContext) -> DensificationStep:
        """Clone, split and prune the Gaussians that are drawn."""
        import torch

        from pop_fast.stages.taming import budget_at, quotas

        scores, nth = self._scores(context), self.densification_at(context.step)
        clones, splits = self.planned_growth(context)
        budget = budget_at(
            nth, self.n_densifications, context.state["first_count"], self.target(context.state["first_count"])
        )
        n_clone, n_split = quotas(budget, len(context), int(clones.sum()), int(splits.sum()))
        clones, splits = _drawn(clones, scores, n_clone, context), _drawn(splits, scores, n_split, context)
        # after the split its parents' rows are gone
        inverse = 1.0 / (1e-6 + scores)
        weights = inverse if self.misaligned_prune_weights else inverse[~splits.cpu()]

        def planned_prune() -> Tensor:
            mask = self.planned_prune(context)
            return torch.zeros_like(mask) if nth > self.sampled_prunes else mask & _drawn_to_go(mask, weights, context)

        return self.densify(context, clones, splits, planned_prune)

    def _scores(self, context: DensificationContext) -> Tensor:
        """Score the Gaussians by a few training views. [N] float64, on the CPU"""
        import torch

        from pop_fast.density.rows import window
        from pop_fast.stages.density import average_grads
        from pop_fast.stages.losses import photometric_3dgs
        from pop_fast.stages.taming import pixel_weights, view_score

        views, params = context.views, context.params
        order = torch.argsort(context.draws.uniforms(views.n_views))[: self.score_views].tolist()
        grads = average_grads(window(context.state), self)
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

    def target(self, first_count: int) -> int:
        """Return the budget."""
        return self.final_count or int(self.budget_multiplier * first_count)


def _drawn(candidates: Tensor, scores: Tensor, wanted: int, context: DensificationContext) -> Tensor:
    """Draw so many candidates by score. [N] bool"""
    import torch

    from pop_fast.stages.selection import sample_without_replacement

    weights = torch.where(candidates.cpu(), scores, 0.0)
    wanted = min(wanted, int((weights > 0.0).sum()))
    mask = torch.zeros(len(weights), dtype=torch.bool)
    mask[sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))] = True
    return mask.to(candidates.device)


def _drawn_to_go(mask: Tensor, weights: Tensor, context: DensificationContext) -> Tensor:
    """Draw half as many as may go, by the weights of the first rows; the others, which are new, stay. [N] bool"""
    import torch

    from pop_fast.stages.selection import sample_without_replacement

    of_all = weights.new_zeros(len(mask))
    of_all[: len(weights)] = weights[: len(mask)]
    wanted = min(int(mask.sum()) // 2, int((of_all > 0.0).sum()))
    drawn = torch.zeros(len(mask), dtype=torch.bool)
    drawn[sample_without_replacement(of_all, wanted, context.draws.uniforms(len(mask)))] = True
    return drawn.to(mask.device)
