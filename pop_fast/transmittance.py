"""Weights of a step of the blend, and where its pixels stop (D7). Meaning: `pop_ref.pixel`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from pop_fast import workspace
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
) -> Tensor | None:
    """Fill the weights of a step and take them off the light; all are 0 from where a pixel stops.

    Args:
        alpha: in and, in tiles where a pixel stops, out. [n, K, P]
        weight: out. [n, K, P]
        light: T, in and out. [n, P]
        before: another copy of the light. [n, P]
        stop: when pixels stop.
        crowded: pixels stop in so many tiles that all are treated alike.
        stopping: the tiles where pixels stop, if known.

    Returns:
        The tiles where pixels stop; None when all were treated alike.
    """
    if crowded:
        _masked(alpha, weight, light, stop)
        return None
    for a, w in zip(alpha.unbind(1), weight.unbind(1), strict=True):
        torch.mul(light, a, out=w)
        # not light - weight: with the product anew the rounding is that of `_masked`, whatever path a tile takes
        light.addcmul_(light, a, value=-1.0)
    if stopping is None:
        stopping = _stopping(light, stop)
        if len(stopping) > CROWDED * len(light):
            _masked(alpha, weight, light.copy_(before), stop)
            return None
    if len(stopping):
        some_alpha, some_light = alpha[stopping], before[stopping]
        some_weight = torch.empty_like(some_alpha)
        _masked(some_alpha, some_weight, some_light, stop)
        weight.index_copy_(0, stopping, some_weight)
        light.index_copy_(0, stopping, some_light)
        alpha.index_copy_(0, stopping, some_alpha)
    return stopping


def count_passed(alpha: Tensor, light: Tensor, stop: Stop) -> Tensor:
    """Count the entries of a step that each pixel goes past without stopping. [n, P] int64"""
    light = light.clone()
    passed = torch.zeros(light.shape, dtype=torch.int64)
    for a in alpha.unbind(1):
        torch.threshold_(light.addcmul_(light, a, value=-1.0), stop.at, 0.0)
        passed += light > 0.0
    return passed


def _masked(alpha: Tensor, weight: Tensor, light: Tensor, stop: Stop) -> None:
    n, length, n_pixels = alpha.shape
    slab = workspace.take(n * (length + 1) * n_pixels, alpha.dtype)
    passing = slab[: n * (length + 1) * n_pixels].view(n, length + 1, n_pixels)
    passing[:, 0] = light
    lights = passing.unbind(1)
    for before, after, a in zip(lights, lights[1:], alpha.unbind(1), strict=False):
        torch.addcmul(before, before, a, value=-1.0, out=after)
        torch.threshold_(after, stop.at, 0.0)
    torch.ops.aten.threshold_backward.grad_input(alpha, passing[:, 1:], 0.0, grad_input=alpha)
    torch.mul(passing[:, :-1], alpha, out=weight)
    light.copy_(passing[:, -1])
    workspace.give(slab)


def _stopping(light: Tensor, stop: Stop) -> Tensor:
    """Return the tiles where some light is left, but no more than the stop."""
    rest = light - torch.threshold(light, stop.at, 0.0)
    return (rest.amax(1) > 0.0).nonzero().squeeze(1)


@lru_cache
def below(value: float, dtype: torch.dtype) -> float:
    """Return the number just under `value` in a type, so that `>` of it means `>= value`."""
    at = torch.tensor(value, dtype=dtype)
    return float(torch.nextafter(at, torch.zeros_like(at)))
