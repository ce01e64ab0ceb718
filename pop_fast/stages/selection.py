"""Which Gaussians are kept, by a score. Meaning: `pop_ref.selection`."""

from __future__ import annotations

import torch
from torch import Tensor

_SMALLEST_MASS = 1e-6


def lowest_share(scores: Tensor, share: float) -> Tensor:
    """See `pop_ref.selection.lowest_share`. [N] bool Optimizations: the threshold is selected, not sorted for.

    Raises:
        ValueError: the share lies outside [0, 1], or a score is not a number.
    """
    _check_share(share)
    bad = scores.isnan().nonzero()
    if len(bad):
        raise ValueError(f"scores[{int(bad[0])}] is nan; scores must be numbers")
    if len(scores) == 0:
        return torch.zeros_like(scores, dtype=torch.bool)
    return scores <= scores.kthvalue(int(share * (len(scores) - 1)) + 1).values


def least_mass(importance: Tensor, share: float = 0.01) -> Tensor:
    """See `pop_ref.selection.least_mass`. [N] bool Optimizations: one sort.

    Raises:
        ValueError: the share lies outside [0, 1], or an importance is negative or not finite.
    """
    _check_share(share)
    importance = _checked_weights("importance", importance)
    ascending = importance.sort().values + _SMALLEST_MASS
    over = (ascending.cumsum(0) / ascending.sum() > share).nonzero()
    if len(over) == 0:
        return torch.ones_like(importance, dtype=torch.bool)
    return importance <= ascending[int(over[0])]


def sample_without_replacement(weights: Tensor, k: int, uniforms: Tensor) -> Tensor:
    """See `pop_ref.selection.sample_without_replacement`. [k] int64 Optimizations: one sort.

    Raises:
        ValueError: k is negative or more than the positive weights, a weight is negative or not finite, or a uniform
            lies outside [0, 1).
    """
    weights = _checked_weights("weights", weights)
    if uniforms.shape != weights.shape:
        raise ValueError(f"uniforms has shape {list(uniforms.shape)}; it must be {list(weights.shape)}, as the weights")
    if not bool(((uniforms >= 0.0) & (uniforms < 1.0)).all()):
        raise ValueError("uniforms must be in [0, 1)")
    racing = (weights > 0.0).nonzero().squeeze(1)
    if not 0 <= k <= len(racing):
        raise ValueError(f"k is {k}; of {len(weights)} weights {len(racing)} are positive, and so many can be drawn")
    arrivals = -torch.log1p(-uniforms[racing].double()) / weights[racing]
    return racing[torch.sort(arrivals, stable=True).indices[:k]].sort().values


def _check_share(share: float) -> None:
    if not 0.0 <= share <= 1.0:
        raise ValueError(f"share is {share}; it must be in [0, 1]")


def _checked_weights(name: str, weights: Tensor) -> Tensor:
    bad = (~((weights >= 0.0) & weights.isfinite())).nonzero()
    if len(bad):
        raise ValueError(f"{name}[{int(bad[0])}] is {float(weights[bad[0]])}; it must be >= 0 and finite")
    return weights.double()
