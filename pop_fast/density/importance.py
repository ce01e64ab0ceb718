"""What methods that prune by importance share: scores summed over the training views, and the lowest of them removed.

The scores are `pop_fast.density.passes`' and the rules `pop_fast.stages.selection`'s, which are held to the oracle.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pop_fast.density import densify
from pop_fast.density.protocol import DensificationContext
from pop_fast.stages.selection import lowest_share


def summed_over_views(context: DensificationContext, score: Callable[[int], Tensor]) -> Tensor:
    """Add up what a score gives for every training view, in float64.

    Args:
        context: the Gaussians, and what a step may ask for.
        score: of a view by its index, any shape.
    """
    total = score(0).to(torch.float64)
    for index in range(1, context.views.n_views):
        total += score(index)
    return total


def prune_lowest(context: DensificationContext, scores: Tensor, share: float) -> int:
    """Remove the share of Gaussians with the lowest scores, and return how many those were."""
    return densify.prune(context, lowest_share(scores, share).to(context.params["means"].device))
