"""Speedy-Splat: 3DGS on exact tile lists, with most Gaussians pruned by their sensitivity during and after growth.

Source: Hanson et al. 2025 and its code. The renderer is profile "speedy_splat", whose tiles are those that the ellipse
of alpha >= 1/255 meets (SnugBox, AccuTile). The score of a Gaussian is the square of what its value at a pixel means
for the pixel's colour, over all pixels of all training views (`pop_ref.sensitivity`). At steps 6000, 9000 and 12000,
after densification and before the opacity reset, the lowest 80 % go; from step 15000 on each 3000 steps the lowest
30 %, after the update. Everything else is 3DGS of 2023.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from pop_fast.density.gsplat import InriaStrategy
from pop_fast.density.protocol import DensificationContext, DensificationStep


@dataclass(frozen=True, kw_only=True)
class SpeedySplatStrategy(InriaStrategy):
    """3DGS with soft pruning while it grows and hard pruning after.

    Attributes:
        soft_prune_iters: steps of soft pruning, each after its densification and before its reset.
        soft_prune_share: share of the Gaussians that each removes.
        hard_prune_iters: steps of hard pruning, each after its update.
        hard_prune_share: share of the Gaussians that each removes.
    """

    soft_prune_iters: tuple[int, ...] = (6_000, 9_000, 12_000)
    soft_prune_share: float = 0.8
    hard_prune_iters: tuple[int, ...] = (15_000, 18_000, 21_000, 24_000, 27_000)
    hard_prune_share: float = 0.3
    scaled_steps = (*InriaStrategy.scaled_steps, "soft_prune_iters", "hard_prune_iters")

    def prune_share_at(self, step: int) -> float:
        """Return the share of the Gaussians that is removed by sensitivity after this step."""
        soft = self.soft_prune_share if step in self.soft_prune_iters else 0.0
        return self.hard_prune_share if step in self.hard_prune_iters else soft

    def needs_passes(self, step: int) -> bool:
        """Tell whether sensitivities are asked for."""
        return self.prune_share_at(step) > 0.0

    def changes_after(self, step: int) -> bool:
        """Tell whether the Gaussians are edited after this step."""
        return super().changes_after(step) or self.needs_passes(step)

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Refine, prune by sensitivity, reset: in this order."""
        done = self.refine(context) if self.is_refine_step(context.step) else DensificationStep()
        share = self.prune_share_at(context.step)
        if share > 0.0:
            from pop_fast.density.rows import prune_lowest, summed_over_views

            views = context.views
            scores = summed_over_views(
                context, lambda index: views.sensitivities(context.params, index, context.sh_degree)
            )
            done = replace(done, pruned=done.pruned + prune_lowest(context, scores, share))
        return self.reset(context, done)
