"""What density control reads of the dict that `rasterization()` returns last."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.density.protocol import Info


def visible_from_radii(radii: Tensor) -> Tensor:
    """Return which Gaussians each camera sees: all extents > 0. [C, N, 2] (or [C, N] before gsplat 1.5) -> [C, N]"""
    return (radii > 0).all(-1) if radii.dim() == 3 else radii > 0


def visible_in(info: Info, n: int) -> Tensor:
    """Return which of n Gaussians any camera sees, packed or not. [N]"""
    if info.get("gaussian_ids") is None:
        return visible_from_radii(info["radii"]).any(0)
    visible = torch.zeros(n, dtype=torch.bool, device=info["radii"].device)
    visible[info["gaussian_ids"].long()] = True
    return visible


def dominant_counts(info: Info) -> Tensor:
    """Return how many pixels each Gaussian dominates in each view, [C, N], or say why it cannot be known."""
    counts = info.get("dominant_counts")
    if counts is None:
        raise ValueError(
            "info has no 'dominant_counts', which POP is built on: render with pop_fast.rasterization "
            "(a drop-in for gsplat's), or put into info how many pixels, [cameras, Gaussians], each one dominates, "
            "that is, has the largest blending weight at"
        )
    return counts
