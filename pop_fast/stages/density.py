"""Which Gaussians blur, clone, split or go, and what a split makes. Meaning and every switch: `pop_ref.density`.

The strategies collect what these functions read, and edit the Gaussians as they say (`strategies.densify`,
`strategies.ops`). `config` is anything with the attributes of `pop_ref.settings.DensityConfig` that a function
reads, a strategy for example.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.covariance import rotmats_from_quats
from pop_ref.settings import SPLIT_CHILDREN, SPLIT_SHRINK

Params = dict[str, Tensor]


@dataclass(frozen=True)
class Statistics:
    """See `pop_ref.density.Statistics`."""

    grad_sum: Tensor
    n_visible: Tensor
    n_views: int
    dominant_sum: Tensor
    blurred: Tensor


def blur_set(
    dominant_counts: Tensor,
    width: int,
    height: int,
    theta_blur: float,
    min_pixels: float = 0.0,
    kept_pixels: int | None = None,
) -> Tensor:
    """See `pop_ref.density.blur_set`. Works for [N] and, view by view, for [C, N]."""
    n_pixels = height * width if kept_pixels is None else kept_pixels
    return dominant_counts > max(theta_blur * n_pixels, min_pixels)


def average_grads(statistics: Statistics, config: Any) -> Tensor:
    """See `pop_ref.density.average_grads`."""
    if config.grad_denominator == "window":
        return statistics.grad_sum / max(statistics.n_views, 1)
    return statistics.grad_sum / statistics.n_visible.clamp_min(1)


def blurs_at(step: int, config: Any) -> bool:
    """See `pop_ref.density.blurs_at`."""
    return config.blur_start_iter <= step <= config.blur_stop_iter


def grow_masks(
    statistics: Statistics, scales: Tensor, scene_scale: float, step: int, config: Any
) -> tuple[Tensor, Tensor]:
    """See `pop_ref.density.grow_masks`."""
    grads = average_grads(statistics, config)
    by_grad = grads >= config.grow_grad2d if config.inclusive else grads > config.grow_grad2d
    by_blur = statistics.blurred & blurs_at(step, config)
    if not config.grow_on_gradient or (blurs_at(step, config) and not config.grow_on_gradient_in_blur_window):
        by_grad = torch.zeros_like(by_grad)
    small = scales.amax(-1) <= config.grow_scale3d * scene_scale
    if config.blur_rule == "split":
        return by_grad & small, (by_grad & ~small) | by_blur
    return (by_grad | by_blur) & small, (by_grad | by_blur) & ~small


def prune_mask(opacities: Tensor, scales: Tensor, scene_scale: float, step: int, config: Any) -> Tensor:
    """See `pop_ref.density.prune_mask`."""
    too_faint = opacities < config.prune_opa
    if not config.prune_too_big or step <= config.prune_too_big_after:
        return too_faint
    return too_faint | (scales.amax(-1) > config.prune_scale3d * scene_scale)


def split_children(params: Mapping[str, Tensor], normals: Tensor, revised_opacity: bool = False) -> Params:
    """Return the children of these parents, all first ones before all second; see `pop_ref.density_rows.split_rows`.

    Optimizations: one batched product for both children of all parents.

    Raises:
        ValueError: `normals` does not hold two draws for each parent.
    """
    if normals.shape != (SPLIT_CHILDREN, *params["means"].shape):
        raise ValueError(f"normals is {list(normals.shape)}; it must be [2, {len(params['means'])}, 3]")
    scales = torch.exp(params["scales"])
    offsets = (rotmats_from_quats(params["quats"]) @ (scales * normals).unsqueeze(-1)).squeeze(-1)
    children = {name: torch.cat([tensor] * SPLIT_CHILDREN) for name, tensor in params.items()}
    children["means"] = (params["means"] + offsets).reshape(-1, 3)
    children["scales"] = torch.log(scales / SPLIT_SHRINK).repeat(SPLIT_CHILDREN, 1)
    if revised_opacity:
        log_left = -0.5 * torch.logaddexp(children["opacities"], torch.zeros_like(children["opacities"]))
        children["opacities"] = torch.log(-torch.expm1(log_left)) - log_left
    return children
