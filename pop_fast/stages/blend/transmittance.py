"""Weights of a step of the blend, and where its pixels stop (D7). Meaning: `pop_ref.pixel`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from pop_ref.constants import Profile


@dataclass(frozen=True)
class Stop:
    """The transmittance that a pixel must stay above.

    Attributes:
        at: a pixel stops where T <= at.
    """

    at: float

    @classmethod
    def of(cls, profile: Profile, dtype: torch.dtype) -> Stop:
        """Return the profile's stop, its strictness folded into the number."""
        stop = profile.transmittance_stop
        return cls(stop if profile.stop_inclusive else below(stop, dtype))


def weights_of_alphas(alpha: Tensor, transmittances: Tensor, stop: Stop) -> Tensor:
    """Take a step's alphas off the light and return the weights; both are 0 from where a pixel stops.

    T never grows, so that one comparison of all T with the stop finds what lies behind it, with no flag carried along.

    Args:
        alpha: in and, where a pixel stops, out. [n, K, P]
        transmittances: T before the step in the first of K + 1 rows; out: T after it in the last, still to be
            compared with the stop, and in the others the weights. [n, K + 1, P]
        stop: when pixels stop.

    Returns:
        The weights, a view of `transmittances`. [n, K, P]
    """
    rows = transmittances.unbind(1)
    for before, after, a in zip(rows, rows[1:], alpha.unbind(1), strict=False):
        torch.addcmul(before, before, a, value=-1.0, out=after)
    torch.ops.aten.threshold_backward.grad_input(alpha, transmittances[:, 1:], stop.at, grad_input=alpha)
    return transmittances[:, :-1].mul_(alpha)


def count_passed(alpha: Tensor, transmittance: Tensor, stop: Stop) -> Tensor:
    """Count the entries of a step that each pixel goes past without stopping. [n, P] int64"""
    transmittance = transmittance.clone()
    passed = torch.zeros(transmittance.shape, dtype=torch.int64)
    for a in alpha.unbind(1):
        torch.threshold_(transmittance.addcmul_(transmittance, a, value=-1.0), stop.at, 0.0)
        passed += transmittance > 0.0
    return passed


@lru_cache
def below(value: float, dtype: torch.dtype) -> float:
    """Return the number just under `value` in a type, so that `>` of it means `>= value`."""
    at = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(at, torch.zeros_like(at)))
