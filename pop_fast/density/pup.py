"""PUP-3DGS: two rounds of pruning by sensitivity and refining, after a whole training of 3DGS.

Source: Hanson et al. 2025 and its code. The score of a Gaussian is the log-determinant of the Fisher block of its mean
and log-scale, summed over pixels and channels of all training views at a quarter of their size (`pop_ref.fisher`). A
round removes the lowest scores, starts Adam anew, and trains 5,000 steps without densification, with the positions'
rate where the training has ended and all others falling by 5 % each 400 steps (`pop_ref.optimizer`). The rounds remove
80 % and then 50 %; the paper's PUP* removes 70 % and then 50 %. What comes before is 3DGS of 2023.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pop_fast.density.gsplat import InriaStrategy
from pop_fast.density.protocol import DensificationContext, DensificationStep
from pop_ref.recipes import BASELINES, Recipe

_PUP: Final[Recipe] = BASELINES["PUP-3DGS"]


@dataclass(frozen=True, kw_only=True)
class PupStrategy(InriaStrategy):
    """3DGS, then rounds of pruning by Fisher blocks and refining.

    Attributes:
        prune_shares: share of the Gaussians that each round removes at its beginning.
        score_divisor: of the training views' width and height, where scores are taken.
    """

    rounds_start_iter: int = _PUP.updates.rounds_start_iter
    prune_shares: tuple[float, ...] = (0.8, 0.5)
    score_divisor: int = 4

    @property
    def adam_restarts(self) -> tuple[int, ...]:
        """Return the first step of every round: it prunes, and moves nothing."""
        return tuple(self.rounds_start_iter + k * self.round_steps for k in range(len(self.prune_shares)))

    def needs_passes(self, step: int) -> bool:
        """Tell whether Fisher blocks are asked for."""
        return step in self.adam_restarts

    def changes_after(self, step: int) -> bool:
        """Tell whether the Gaussians are edited after this step."""
        return super().changes_after(step) or self.needs_passes(step)

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Refine and reset as 3DGS; at the beginning of a round prune and start Adam anew."""
        if context.step not in self.adam_restarts:
            return super().edit(context)
        from pop_fast.density.rows import prune_lowest, restart, summed_over_views
        from pop_fast.stages.contributions import log_det_scores

        views, divisor = context.views, self.score_divisor
        blocks = summed_over_views(
            context, lambda index: views.fisher(context.params, index, context.sh_degree, divisor)
        )
        share = self.prune_shares[self.adam_restarts.index(context.step)]
        pruned = prune_lowest(context, log_det_scores(blocks), share)
        restart(context.params, context.optimizers)
        return DensificationStep(pruned=pruned)
