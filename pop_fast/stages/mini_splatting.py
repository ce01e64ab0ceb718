"""Mini-Splatting's importance, and what its new clouds of points are made with. Meaning: `pop_ref.mini_splatting`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from pop_fast.stages.contributions import Contributions
from pop_fast.stages.neighbours import mean_squared_distances

_LEAST_SQUARED_DISTANCE = 1e-7


def view_importance(found: Contributions, dominant_counts: Tensor, outdoor: bool) -> Tensor:
    """See `pop_ref.mini_splatting.view_importance`. [N] float64 Optimizations: none."""
    if not outdoor:
        return found.weight_sum.clone()
    return torch.where(dominant_counts > 0, found.weight_sum / found.n_pixels.clamp_min(1), 0.0)


def scene_importance(views: Sequence[tuple[Contributions, Tensor]], outdoor: bool) -> Tensor:
    """See `pop_ref.mini_splatting.scene_importance`. [N] float64 Optimizations: none.

    Raises:
        ValueError: there are no views.
    """
    if not views:
        raise ValueError("there are no views; importance is a sum over at least one")
    importance = torch.stack([view_importance(found, counts, outdoor) for found, counts in views]).sum(0)
    dominant = torch.stack([counts > 0 for _, counts in views]).any(0)
    return torch.where(dominant, importance, 0.0)


def samples_per_view(n_views: int, width: int, height: int, max_points: int = 3_500_000) -> int:
    """See `pop_ref.mini_splatting.samples_per_view`. Optimizations: none.

    Raises:
        ValueError: there is no view.
    """
    if n_views < 1:
        raise ValueError(f"n_views is {n_views}; it must be >= 1")
    return min(max_points // n_views, width * height)


def nearest_log_scales(points: Tensor) -> Tensor:
    """See `pop_ref.mini_splatting.nearest_log_scales`. [N, 3] Optimizations: a tree of the points."""
    squared = mean_squared_distances(points.detach().double().cpu().numpy())
    log_scales = 0.5 * np.log(np.maximum(squared, _LEAST_SQUARED_DISTANCE))
    return torch.from_numpy(log_scales).to(points)[:, None].repeat(1, 3)
