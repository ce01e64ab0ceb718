"""Terms of the loss for captures of few photographs. Meaning: `pop_ref.regularizers`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.types import Camera


def depth_samples(points: Tensor, camera: Camera, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """See `pop_ref.regularizers.depth_samples`; points [P, 3], mask bool [H, W] or None.

    Optimizations: all points at once.
    """
    in_camera = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    in_camera = in_camera[in_camera[:, 2] > 0.0]
    depths = in_camera[:, 2]
    places = (in_camera / depths[:, None]) @ camera.K[:2].T
    shown = (places >= 0.0).all(1) & (places[:, 0] < camera.width) & (places[:, 1] < camera.height)
    if mask is not None:
        column, row = places.nan_to_num().long().unbind(1)
        shown &= mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return places[shown], 1.0 / depths[shown]


def sparse_depth_loss(depth: Tensor, places: Tensor, disparities: Tensor) -> Tensor:
    """See `pop_ref.regularizers.sparse_depth_loss`; differentiable in `depth` [H, W], by torch's own graph.

    Optimizations: all samples at once.
    """
    height, width = depth.shape
    u, v = (places[:, 0] - 0.5).clamp(0.0, width - 1.0), (places[:, 1] - 0.5).clamp(0.0, height - 1.0)
    left, top = u.long(), v.long()
    right, bottom = (left + 1).clamp_max(width - 1), (top + 1).clamp_max(height - 1)
    a, b = u - left, v - top
    above = (1.0 - a) * depth[top, left] + a * depth[top, right]
    below = (1.0 - a) * depth[bottom, left] + a * depth[bottom, right]
    sampled = (1.0 - b) * above + b * below
    seen = sampled > 0.0
    # what is divided is never 0, so that no gradient is a product of 0 and infinity
    rendered = torch.where(seen, 1.0 / torch.where(seen, sampled, 1.0), 0.0)
    return (rendered - disparities).abs().sum() / max(len(disparities), 1)


def mean_activation(values: Tensor) -> Tensor:
    """See `pop_ref.regularizers.mean_activation`; differentiable in `values`.

    Optimizations: none.
    """
    return values.sum() / max(values.numel(), 1)
