"""Weights of a step of the blend, and where its pixels stop (D7). Meaning: `pop_ref.pixel`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from pop_ref.constants import Profile

CROWDED = 0.15  # share of tiles with a stopping pixel from which all tiles are treated as such


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


def weights_of_alphas(
    alpha: Tensor,
    weight: Tensor,
    light: Tensor,
    before: Tensor,
    stop: Stop,
    crowded: bool,
    stopping: Tensor | None = None,
    alpha_too: bool = False,
) -> Tensor | None:
    """Fill the weights of a step and take them off the light; weights and light are 0 from where a pixel stops.

    Args:
        alpha: in and, for `alpha_too`, out. [n, K, P]
        weight: out. [n, K, P]
        light: T, in and out. [n, P]
        before: another copy of the light. [n, P]
        stop: when pixels stop.
        crowded: pixels stop in so many tiles that all are treated alike.
        stopping: the tiles where pixels stop, if known.
        alpha_too: zero alphas as well where pixels stop, in the tiles where one stops in this step.

    Returns:
        The tiles where pixels stop; None when all were treated alike.
    """
    if crowded:
        _masked(alpha, weight, light, stop, alpha_too)
        return None
    for a, w in zip(alpha.unbind(1), weight.unbind(1), strict=True):
        torch.mul(light, a, out=w)
        light.sub_(w)
    if stopping is None:
        stopping = _stopping(light, stop)
        if len(stopping) > CROWDED * len(light):
            _masked(alpha, weight, light.copy_(before), stop, alpha_too)
            return None
    if len(stopping):
        some_alpha, some_light = alpha[stopping], before[stopping]
        some_weight = torch.empty_like(some_alpha)
        _masked(some_alpha, some_weight, some_light, stop, alpha_too)
        weight.index_copy_(0, stopping, some_weight)
        light.index_copy_(0, stopping, some_light)
        if alpha_too:
            alpha.index_copy_(0, stopping, some_alpha)
    return stopping


def count_passed(alpha: Tensor, light: Tensor, stop: Stop) -> Tensor:
    """Count the entries of a step that each pixel goes past without stopping. [n, P] int64"""
    light = light.clone()
    passed = torch.zeros(light.shape, dtype=torch.int64)
    for a in alpha.unbind(1):
        torch.threshold_(light.sub_(light * a), stop.at, 0.0)
        passed += light > 0.0
    return passed


def _masked(alpha: Tensor, weight: Tensor, light: Tensor, stop: Stop, alpha_too: bool) -> None:
    zero_where = torch.ops.aten.threshold_backward.grad_input
    for a, w in zip(alpha.unbind(1), weight.unbind(1), strict=True):
        torch.mul(light, a, out=w)
        torch.threshold_(light.sub_(w), stop.at, 0.0)
        zero_where(w, light, 0.0, grad_input=w)
        if alpha_too:
            zero_where(a, light, 0.0, grad_input=a)


def _stopping(light: Tensor, stop: Stop) -> Tensor:
    """Return the tiles where some light is left, but no more than the stop."""
    rest = light - torch.threshold(light, stop.at, 0.0)
    return (rest.amax(1) > 0.0).nonzero().squeeze(1)


@lru_cache
def below(value: float, dtype: torch.dtype) -> float:
    """Return the number just under `value` in a type, so that `>` of it means `>= value`."""
    at = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(at, torch.zeros_like(at)))
