"""Adaptive density control as tensor operations. Meaning, order of rows and every switch: `pop_ref.density`.

`config` is anything with the attributes of `pop_ref.settings.DensityConfig` that a function reads, a strategy for
example. Rows are dictionaries of tensors with one common first axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pop_fast.covariance import rotmats_from_quats
from pop_ref.settings import POP, SPLIT_CHILDREN, SPLIT_SHRINK

Params = dict[str, Tensor]


@dataclass(frozen=True)
class Rows:
    """See `pop_ref.density_rows.Rows`."""

    params: Mapping[str, Tensor]
    m: Mapping[str, Tensor]
    v: Mapping[str, Tensor]

    def __len__(self) -> int:
        return len(next(iter(self.params.values())))


@dataclass(frozen=True)
class Statistics:
    """See `pop_ref.density.Statistics`."""

    grad_sum: Tensor
    n_visible: Tensor
    n_views: int
    dominant_sum: Tensor
    blurred: Tensor


def rows_from_params(params: Mapping[str, Tensor]) -> Rows:
    """See `pop_ref.density_rows.rows_from_params`."""
    m = {name: torch.zeros_like(tensor) for name, tensor in params.items()}
    return Rows(dict(params), m, {name: torch.zeros_like(tensor) for name, tensor in params.items()})


def zero_statistics(n: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Statistics:
    """See `pop_ref.density.zero_statistics`."""
    counts = torch.zeros(n, dtype=torch.int64, device=device)
    flags = torch.zeros(n, dtype=torch.bool, device=device)
    return Statistics(torch.zeros(n, dtype=dtype, device=device), counts, 0, counts.clone(), flags)


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


def accumulate(
    statistics: Statistics,
    v_means2d: Tensor,
    visible: Tensor,
    dominant_counts: Tensor,
    width: int,
    height: int,
    config: Any,
    kept_pixels: int | None = None,
) -> Statistics:
    """See `pop_ref.density.accumulate`.

    Optimizations: one fused norm over the scaled gradient.
    """
    unit = v_means2d.new_tensor([0.5 * width, 0.5 * height])
    grads = torch.linalg.vector_norm(v_means2d * unit, dim=-1)
    dominant_sum = statistics.dominant_sum + dominant_counts
    tested = dominant_sum if config.blur_window == "sum" else dominant_counts
    blurred = blur_set(tested, width, height, config.theta_blur, config.blur_min_pixels, kept_pixels)
    return Statistics(
        grad_sum=statistics.grad_sum + grads.masked_fill(~visible, 0.0),
        n_visible=statistics.n_visible + visible,
        n_views=statistics.n_views + 1,
        dominant_sum=dominant_sum,
        blurred=blurred | statistics.blurred if config.blur_window == "any_view" else blurred,
    )


def average_grads(statistics: Statistics, config: Any) -> Tensor:
    """See `pop_ref.density.average_grads`."""
    if config.grad_denominator == "window":
        return statistics.grad_sum / max(statistics.n_views, 1)
    return statistics.grad_sum / statistics.n_visible.clamp_min(1)


def blurs_at(step: int, config: Any) -> bool:
    """See `pop_ref.density_config.blurs_at`."""
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


def clone_rows(rows: Rows, mask: Tensor) -> Rows:
    """See `pop_ref.density_rows.clone_rows`."""
    return _keep_and_append(rows, None, {name: tensor[mask] for name, tensor in rows.params.items()})


def split_children(params: Mapping[str, Tensor], normals: Tensor, revised_opacity: bool = False) -> Params:
    """Return the children of these parents, all first ones before all second; see `pop_ref.density_rows.split_rows`.

    Optimizations: one batched product for both children of all parents.
    """
    scales = torch.exp(params["scales"])
    offsets = (rotmats_from_quats(params["quats"]) @ (scales * normals).unsqueeze(-1)).squeeze(-1)
    children = {name: torch.cat([tensor] * SPLIT_CHILDREN) for name, tensor in params.items()}
    children["means"] = (params["means"] + offsets).reshape(-1, 3)
    children["scales"] = torch.log(scales / SPLIT_SHRINK).repeat(SPLIT_CHILDREN, 1)
    if revised_opacity:
        log_left = -0.5 * torch.logaddexp(children["opacities"], torch.zeros_like(children["opacities"]))
        children["opacities"] = torch.log(-torch.expm1(log_left)) - log_left
    return children


def split_rows(rows: Rows, mask: Tensor, normals: Tensor, revised_opacity: bool = False) -> Rows:
    """See `pop_ref.density_rows.split_rows`."""
    parents = {name: tensor[mask] for name, tensor in rows.params.items()}
    if normals.shape != (SPLIT_CHILDREN, *parents["means"].shape):
        raise ValueError(f"normals is {list(normals.shape)}; it must be [2, {len(parents['means'])}, 3]")
    return _keep_and_append(rows, ~mask, split_children(parents, normals, revised_opacity))


def prune_rows(rows: Rows, mask: Tensor) -> Rows:
    """See `pop_ref.density_rows.prune_rows`."""
    return _keep_and_append(rows, ~mask, {name: tensor[:0] for name, tensor in rows.params.items()})


def reset_opacities(rows: Rows, ceiling: float = POP.reset_opa) -> Rows:
    """See `pop_ref.density_rows.reset_opacities`."""
    opacities = rows.params["opacities"]
    logit = torch.logit(torch.tensor(ceiling, dtype=torch.float64)).item()
    return Rows(
        {**rows.params, "opacities": opacities.clamp_max(logit)},
        {**rows.m, "opacities": torch.zeros_like(opacities)},
        {**rows.v, "opacities": torch.zeros_like(opacities)},
    )


def densify_and_prune(
    rows: Rows, statistics: Statistics, scene_scale: float, step: int, normals: Callable[[int], Tensor], config: Any
) -> tuple[Rows, Statistics]:
    """See `pop_ref.density.densify_and_prune`."""
    clone, split = grow_masks(statistics, torch.exp(rows.params["scales"]), scene_scale, step, config)
    rows = clone_rows(rows, clone)
    split = torch.cat([split, split.new_zeros(int(clone.sum()))])
    rows = split_rows(rows, split, normals(int(split.sum())), config.revised_opacity)
    opacities, scales = torch.sigmoid(rows.params["opacities"]), torch.exp(rows.params["scales"])
    rows = prune_rows(rows, prune_mask(opacities, scales, scene_scale, step, config))
    return rows, zero_statistics(len(rows), statistics.grad_sum.dtype, statistics.grad_sum.device)


def _keep_and_append(rows: Rows, keep: Tensor | None, new: Mapping[str, Tensor]) -> Rows:
    """Gather the kept rows of every tensor, then append the new rows with zero moments."""

    def edited(tensor: Tensor, tail: Tensor) -> Tensor:
        return torch.cat([tensor if keep is None else tensor[keep], tail])

    params = {name: edited(tensor, new[name]) for name, tensor in rows.params.items()}
    m = {name: edited(tensor, torch.zeros_like(new[name])) for name, tensor in rows.m.items()}
    v = {name: edited(tensor, torch.zeros_like(new[name])) for name, tensor in rows.v.items()}
    return Rows(params, m, v)
