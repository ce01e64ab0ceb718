"""Exposure of photographs, colour correction for measurements, random backgrounds. Meaning: `pop_ref.appearance`."""

from __future__ import annotations

import torch
from torch import Tensor

_GOLDEN = 0x9E3779B97F4A7C15
_MIX = (0xBF58476D1CE4E5B9, 0x94D049BB133111EB)
_WORD = 2**64 - 1
_LEAST = 1e-8


def expose(image: Tensor, exposure: Tensor) -> Tensor:
    """See `pop_ref.appearance.expose`; differentiable in both, by torch's own graph.

    Optimizations: one matrix product over all pixels.
    """
    return torch.addmm(exposure[:, 3], image.reshape(-1, 3), exposure[:, :3].T).view_as(image)


def centred_exposures(exposures: Tensor) -> Tensor:
    """See `pop_ref.appearance.centred_exposures`.

    Optimizations: none.
    """
    return exposures - (exposures.mean(0) - torch.eye(3, 4, dtype=exposures.dtype))


def color_correct(image: Tensor, target: Tensor) -> Tensor:
    """See `pop_ref.appearance.color_correct`.

    Optimizations: all channels at once, in double precision, since variances are differences of large sums.
    """
    c, t = image.double(), target.double()
    variance = ((t * t).mean(0) - t.mean(0) ** 2).clamp_min(_LEAST)
    slope = ((t * c).mean(0) - t.mean(0) * c.mean(0)) / variance
    offset = c.mean(0) - slope * t.mean(0)
    slope = torch.where(slope.abs() >= _LEAST, slope, 1.0)
    return ((c - offset) / slope).clamp(0.0, 1.0).to(image)


def background_at(step: int, seed: int) -> Tensor:
    """See `pop_ref.appearance.background_at`. float64 [3]

    Optimizations: none.
    """
    start = _mixed(seed)
    words = [_mixed((start + (3 * step + channel + 1) * _GOLDEN) & _WORD) for channel in range(3)]
    return torch.tensor([(word >> 11) * 2.0**-53 for word in words], dtype=torch.float64)


def over_background(photo: Tensor, alpha: Tensor, was: Tensor, now: Tensor) -> Tensor:
    """See `pop_ref.appearance.over_background`.

    Optimizations: none.
    """
    return photo + (1.0 - alpha)[:, :, None] * (now - was)


def _mixed(word: int) -> int:
    word &= _WORD
    word = ((word ^ (word >> 30)) * _MIX[0]) & _WORD
    word = ((word ^ (word >> 27)) * _MIX[1]) & _WORD
    return word ^ (word >> 31)
