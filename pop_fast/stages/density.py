"""Which Gaussians blur, clone, split, go or are drawn, and what new ones are made with, by POP and the other methods.

Meaning and every switch: `pop_ref.density`, `pop_ref.selection`, `pop_ref.mini_splatting`, `pop_ref.taming`. The
strategies collect what these functions read, and edit the Gaussians as they say. `config` is anything with the
attributes of `pop_ref.settings.DensityConfig` that a function reads, a strategy for example.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from pop_fast.stages.contributions import Contributions
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


_SMALLEST_MASS = 1e-6


def lowest_share(scores: Tensor, share: float) -> Tensor:
    """See `pop_ref.selection.lowest_share`. [N] bool Optimizations: the threshold is selected, not sorted for.

    Raises:
        ValueError: the share is outside [0, 1], or a score is not a number.
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
        ValueError: the share is outside [0, 1], or an importance is negative or not finite.
    """
    _check_share(share)
    importance = _checked_weights("importance", importance)
    ascending = importance.sort().values + _SMALLEST_MASS
    mass = ascending.cumsum(0)
    # a sum of its own would depend on the number of threads
    over = (mass / mass[-1:] > share).nonzero()
    if len(over) == 0:
        return torch.ones_like(importance, dtype=torch.bool)
    return importance <= ascending[int(over[0])]


def sample_without_replacement(weights: Tensor, k: int, uniforms: Tensor) -> Tensor:
    """See `pop_ref.selection.sample_without_replacement`. [k] int64 Optimizations: one sort.

    Raises:
        ValueError: k is negative or more than the positive weights, a weight is negative or not finite, or a uniform
            is outside [0, 1).
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


_LEAST_SQUARED_DISTANCE = 1e-7


def view_importance(found: Contributions, dominant_counts: Tensor, outdoor: bool) -> Tensor:
    """See `pop_ref.mini_splatting.view_importance`. [N] float64"""
    if not outdoor:
        return found.weight_sum.clone()
    return torch.where(dominant_counts > 0, found.weight_sum / found.n_pixels.clamp_min(1), 0.0)


def scene_importance(views: Sequence[tuple[Contributions, Tensor]], outdoor: bool) -> Tensor:
    """See `pop_ref.mini_splatting.scene_importance`; ValueError without a view. [N] float64"""
    if not views:
        raise ValueError("there are no views; importance is a sum over at least one")
    importance = torch.stack([view_importance(found, counts, outdoor) for found, counts in views]).sum(0)
    dominant = torch.stack([counts > 0 for _, counts in views]).any(0)
    return torch.where(dominant, importance, 0.0)


def samples_per_view(n_views: int, width: int, height: int, max_points: int = 3_500_000) -> int:
    """See `pop_ref.mini_splatting.samples_per_view`; ValueError where there is no view."""
    if n_views < 1:
        raise ValueError(f"n_views is {n_views}; it must be >= 1")
    return min(max_points // n_views, width * height)


def nearest_log_scales(points: Tensor) -> Tensor:
    """See `pop_ref.mini_splatting.nearest_log_scales`. [N, 3] Optimizations: a tree of the points."""
    squared = mean_squared_distances(points.detach().double().cpu().numpy())
    log_scales = 0.5 * np.log(np.maximum(squared, _LEAST_SQUARED_DISTANCE))
    return torch.from_numpy(log_scales).to(points)[:, None].repeat(1, 3)


# weights of the nine terms, of the view and of the two halves of the pixel map
GRAD, OPACITY, DEPTH, RADIUS, SCALE = 25.0, 100.0, 5.0, 10.0, 25.0
DISTANCE, LOSS, COUNT, BLEND = 50.0, 10.0, 0.1, 50.0
VIEW, ERROR, EDGE = 50.0, 50.0, 50.0

# of "L" images: 0.299, 0.587, 0.114 in units of 2^-16
_LUMA = (19595, 38470, 7471)


def budget_at(nth: int, n: int, start: int, target: int) -> int:
    """See `pop_ref.taming.budget_at`; ValueError where nth is outside 0 to n, or there are none."""
    if n < 1 or not 0 <= nth <= n:
        raise ValueError(f"nth is {nth} of {n}; it must be in 0 to n, and n >= 1")
    return start + (target - start) * (2 * n * nth - nth * nth) // (n * n)


def edge_map(photo: Tensor) -> Tensor:
    """See `pop_ref.taming.edge_map`. [H, W] float32 Optimizations: whole rows and columns are added up.

    Raises:
        ValueError: the photograph is not uint8 [H, W, 3].
    """
    if photo.dtype != torch.uint8 or photo.dim() != 3 or photo.shape[2] != 3:
        raise ValueError(f"photo is {photo.dtype} {list(photo.shape)}; it must be uint8 [H, W, 3]")
    red, green, blue = photo.to(torch.int32).unbind(2)
    grey = (_LUMA[0] * red + _LUMA[1] * green + _LUMA[2] * blue + (1 << 15)) >> 16
    edges = grey.clone()
    if min(grey.shape) > 2:
        columns = grey[:, :-2] + grey[:, 1:-1] + grey[:, 2:]
        neighbourhood = columns[:-2] + columns[1:-1] + columns[2:]
        edges[1:-1, 1:-1] = (9 * grey[1:-1, 1:-1] - neighbourhood).clamp(0, 255)
    return edges.to(torch.float32)


def pixel_weights(image: Tensor, photo: Tensor, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.taming.pixel_weights`; ValueError where a photograph is not uint8 [H, W, 3] as the image. [H, W]"""
    edges = edge_map(photo).to(image.dtype)
    if image.shape != photo.shape:
        raise ValueError(f"image has shape {list(image.shape)}, photo {list(photo.shape)}; they must be the same")
    error = (image - photo.to(image.dtype) / 255.0).abs().mean(2)
    return ERROR * _minmax(error, mask) + EDGE * _minmax(edges, mask)


def scaled_to_median(c: float, x: Tensor) -> Tensor:
    """See `pop_ref.taming.scaled_to_median`. [N] float64 Optimizations: the median is selected, not sorted for."""
    x = x.double()
    positive = x[x > 0.0]
    if len(positive) == 0:
        return torch.zeros_like(x)
    return torch.where(x > 0.0, c * (x / positive.median()), 0.0)


def view_score(
    photometric: float | Tensor,
    grads: Tensor,
    opacities: Tensor,
    scales: Tensor,
    depths: Tensor,
    radii: Tensor,
    found: Contributions,
) -> Tensor:
    """See `pop_ref.taming.view_score`. [N] float64"""
    visible = (radii > 0).all(1)
    terms = (
        scaled_to_median(GRAD, grads)
        + scaled_to_median(OPACITY, opacities)
        + scaled_to_median(DEPTH, torch.where(visible, depths, 0.0))
        + scaled_to_median(RADIUS, torch.where(visible, torch.maximum(radii[:, 0], radii[:, 1]), 0))
        + scaled_to_median(SCALE, scales.double().prod(1))
        + scaled_to_median(DISTANCE, found.distance_sum)
        + scaled_to_median(LOSS, found.map_sum)
        + scaled_to_median(COUNT, found.n_pixels)
        + scaled_to_median(BLEND, found.weight_sum)
    )
    return torch.where(visible, VIEW * float(photometric) * terms, 0.0)


def quotas(budget: int, n: int, n_clone: int, n_split: int) -> tuple[int, int]:
    """See `pop_ref.taming.quotas`."""
    n_candidates = n_clone + n_split
    more = max(min(budget, n + n_candidates) - n, 0)
    return more * n_clone // max(n_candidates, 1), more * n_split // max(n_candidates, 1)


def _minmax(x: Tensor, mask: Tensor | None) -> Tensor:
    kept = x if mask is None else x[mask]
    if kept.numel() == 0 or bool(kept.max() == kept.min()):
        return torch.zeros_like(x)
    least, greatest = kept.aminmax()
    scaled = (x - least) / (greatest - least)
    return scaled if mask is None else scaled.masked_fill_(~mask, 0.0)


def mean_squared_distances(points: np.ndarray) -> np.ndarray:
    """Return each point's mean squared distance to its three nearest others, or to all where there are fewer.

    Args:
        points: any unit; those that coincide are each other's nearest. [N, 3]

    Returns:
        In the squared unit; 0 for a single point. [N] float64
    """
    n = len(points)
    if n < 2:
        return np.zeros(n)
    # a point is its own nearest neighbour
    nearest = np.asarray(KDTree(points).query(points, k=min(4, n))[0])[:, 1:]
    return np.mean(nearest**2, axis=1)
