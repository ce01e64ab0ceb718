"""What training corrects of photographs and cameras.

`pop_ref.appearance` states the exposure of photographs, the colour correction for measurements and random backgrounds;
`pop_ref.refinement` small corrections of cameras.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.types import once_differentiable

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
    """See `pop_ref.appearance.centred_exposures`."""
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
    """See `pop_ref.appearance.background_at`. float64 [3]"""
    start = _mixed(seed)
    words = [_mixed((start + (3 * step + channel + 1) * _GOLDEN) & _WORD) for channel in range(3)]
    return torch.tensor([(word >> 11) * 2.0**-53 for word in words], dtype=torch.float64)


def over_background(photo: Tensor, alpha: Tensor, was: Tensor, now: Tensor) -> Tensor:
    """See `pop_ref.appearance.over_background`."""
    return photo + (1.0 - alpha)[:, :, None] * (now - was)


def _mixed(word: int) -> int:
    word &= _WORD
    word = ((word ^ (word >> 30)) * _MIX[0]) & _WORD
    word = ((word ^ (word >> 27)) * _MIX[1]) & _WORD
    return word ^ (word >> 31)


_SMALL = 1e-2


def rotmat_from_vector(vector: Tensor) -> Tensor:
    """See `pop_ref.refinement.rotmat_from_vector`."""
    a, b, _, _ = _coefficients(float(vector.double() @ vector.double()))
    K = _cross(vector)
    return torch.eye(3, dtype=vector.dtype) + a * K + b * (K @ K)


def rotmat_from_vector_vjp(vector: Tensor, v_rotmat: Tensor) -> Tensor:
    """See `pop_ref.refinement.rotmat_from_vector_vjp`."""
    a, b, a_slope, b_slope = _coefficients(float(vector.double() @ vector.double()))
    K = _cross(vector)
    v_K = a * v_rotmat + b * (v_rotmat @ K.T + K.T @ v_rotmat)
    v_s = a_slope * (v_rotmat * K).sum() + b_slope * (v_rotmat * (K @ K)).sum()
    through_K = torch.stack([v_K[2, 1] - v_K[1, 2], v_K[0, 2] - v_K[2, 0], v_K[1, 0] - v_K[0, 1]])
    return through_K + 2.0 * v_s * vector


def refined_viewmat(viewmat: Tensor, correction: Tensor) -> Tensor:
    """See `pop_ref.refinement.refined_viewmat`; differentiable in both."""
    return _Refined.apply(viewmat, correction)


def refined_viewmat_vjp(viewmat: Tensor, correction: Tensor, v_refined: Tensor) -> tuple[Tensor, Tensor]:
    """See `pop_ref.refinement.refined_viewmat_vjp`."""
    v_viewmat = torch.zeros_like(viewmat)
    v_viewmat[:3] = rotmat_from_vector(correction[:3]).T @ v_refined[:3]
    v_motion = v_refined[:3] @ viewmat.T
    return v_viewmat, torch.cat([rotmat_from_vector_vjp(correction[:3], v_motion[:, :3]), v_motion[:, 3]])


def without_common_motion(corrections: Tensor, viewmats: Tensor) -> Tensor:
    """See `pop_ref.refinement.without_common_motion`.

    Optimizations: none; in double precision, so that nothing is lost where a few cameras hardly fix the motion.
    """
    R, t = viewmats[:, :3, :3].double(), viewmats[:, :3, 3].double()
    A = R.new_zeros((len(viewmats), 6, 6))
    A[:, :3, :3], A[:, 3:, 3:] = R, R
    A[:, 3:, :3] = torch.linalg.cross(t[:, :, None].expand_as(R), R, dim=1)
    stacked, wide = corrections.double().reshape(-1, 1), A.reshape(-1, 6)
    common = torch.linalg.lstsq(wide, stacked, driver="gelsd").solution
    return (stacked - wide @ common).view_as(corrections).to(corrections)


class _Refined(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, viewmat: Tensor, correction: Tensor) -> Tensor:
        ctx.save_for_backward(viewmat, correction)
        motion = torch.eye(4, dtype=viewmat.dtype)
        motion[:3, :3] = rotmat_from_vector(correction[:3])
        motion[:3, 3] = correction[3:]
        return motion @ viewmat

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_refined: Tensor) -> tuple[Tensor, Tensor]:
        viewmat, correction = ctx.saved_tensors
        return refined_viewmat_vjp(viewmat, correction, v_refined)


def _cross(vector: Tensor) -> Tensor:
    x, y, z = vector.unbind()
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)


def _coefficients(s: float) -> tuple[float, float, float, float]:
    """Return a, b and their derivatives by s = |w|^2: Taylor series where these would be differences of equals."""
    if s < _SMALL:
        a = sum((-s) ** k / math.factorial(2 * k + 1) for k in range(8))
        b = sum((-s) ** k / math.factorial(2 * k + 2) for k in range(8))
        a_slope = -sum((k + 1) * (-s) ** k / math.factorial(2 * k + 3) for k in range(8))
        b_slope = -sum((k + 1) * (-s) ** k / math.factorial(2 * k + 4) for k in range(8))
        return a, b, a_slope, b_slope
    angle = math.sqrt(s)
    a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / s
    return a, b, (math.cos(angle) - a) / (2.0 * s), (a - 2.0 * b) / (2.0 * s)
