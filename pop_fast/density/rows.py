"""Edits of the Gaussians that carry the optimizers' moments and the statistics with their rows.

Every edit is one call of `edit_rows`: keep some rows, append others. Rows that are kept keep their bits and their
order, in every parameter, in every moment and in every per-Gaussian tensor of the state. Rows that are appended start
with zero moments; an optimizer's scalar step counter is never touched. Where processes share the Gaussians out, an
optimizer may hold a number a row in place of moments, and colours may be such numbers, which edits copy as any
parameter's rows (`pop_fast.train.stepper.OwnRows`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from pop_fast.density.protocol import DensificationContext, Optimizers, Params, State
from pop_fast.stages.density import Statistics, lowest_share, split_children
from pop_ref.settings import SPLIT_CHILDREN


@torch.no_grad()
def edit_rows(
    params: Params,
    optimizers: Optimizers,
    state: State,
    keep: Tensor | None = None,
    appended: Mapping[str, Tensor] | None = None,
    sources: Tensor | None = None,
) -> None:
    """Keep the rows of the mask `keep` (None: all) and append rows after them.

    Args:
        params: raw parameters, replaced in place under their keys.
        optimizers: one per key; their moments follow the rows.
        state: the strategy's state; its tensors with one row per Gaussian follow the rows.
        keep: which rows stay. [N] bool
        appended: the new rows of every parameter.
        sources: the old row that each new row's statistics are copied from. [M] int64
    """
    rows = len(next(iter(params.values())))

    def edited(old: Tensor, tail: Tensor | None) -> Tensor:
        head = old if keep is None else old[keep]
        return head.clone() if tail is None else torch.cat([head, tail])

    for key in list(params):
        old = params[key]
        tail = None if appended is None else appended[key].to(old.dtype)
        new = torch.nn.Parameter(edited(old.detach(), tail), requires_grad=old.requires_grad)
        params[key] = new
        if key not in optimizers:
            continue
        optimizer = optimizers[key]
        moments = optimizer.state.pop(old, {})
        for name, value in moments.items():
            if isinstance(value, Tensor) and value.shape[:1] == old.shape[:1]:
                moments[name] = edited(value, None if tail is None else value.new_zeros((len(tail), *value.shape[1:])))
        if moments:
            optimizer.state[new] = moments
        optimizer.param_groups[0]["params"] = [new]
    for name, value in state.items():
        if isinstance(value, Tensor) and value.dim() > 0 and len(value) == rows:
            state[name] = edited(value, None if sources is None else value[sources])


def clone(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """Append an exact copy of every selected Gaussian; the source keeps its moments, the copy starts with none."""
    appended = {key: value.detach()[mask] for key, value in params.items()}
    edit_rows(params, optimizers, state, appended=appended, sources=torch.nonzero(mask)[:, 0])


def split(
    params: Params,
    optimizers: Optimizers,
    state: State,
    mask: Tensor,
    normals: Tensor,
    revised_opacity: bool = False,
) -> None:
    """Replace every selected Gaussian by two, drawn from it and 1.6 times smaller.

    `mean' = mean + R(q) (s * normals)`, `s' = s / 1.6`; rotation, colour and opacity are copied. Survivors come first,
    then all first children, then all second children.

    Args:
        normals: standard normal draws for the first and the second child of each, of any precision. [2, M, 3]
        revised_opacity: give the children `1 - sqrt(1 - o)`, so that two coincident ones equal the parent.

    Raises:
        ValueError: `normals` does not hold two draws for each selected Gaussian.
    """
    chosen = {key: value.detach()[mask] for key, value in params.items()}
    appended = split_children(chosen, normals.to(chosen["means"]), revised_opacity)
    sources = torch.nonzero(mask)[:, 0].repeat(SPLIT_CHILDREN)
    edit_rows(params, optimizers, state, keep=~mask, appended=appended, sources=sources)


def prune(params: Params, optimizers: Optimizers, state: State, mask: Tensor) -> None:
    """Remove every selected Gaussian with its moments and statistics."""
    edit_rows(params, optimizers, state, keep=~mask)


@torch.no_grad()
def reset_opacities(params: Params, optimizers: Optimizers, ceiling: float) -> None:
    """Lower every opacity to `min(o, ceiling)` and forget the moments of all opacities, the step counter excepted."""
    opacities = params["opacities"]
    opacities.clamp_(max=math.log(ceiling / (1.0 - ceiling)))
    for value in optimizers["opacities"].state.get(opacities, {}).values():
        if isinstance(value, Tensor) and value.shape == opacities.shape:
            value.zero_()


@torch.no_grad()
def replace_rows(params: Params, optimizers: Optimizers, state: State, rows: Mapping[str, Tensor]) -> None:
    """Let new Gaussians take the place of all there are, with Adam anew; statistics are left with no rows."""
    none = torch.zeros(len(params["means"]), dtype=torch.bool, device=params["means"].device)
    edit_rows(params, optimizers, state, keep=none, appended=rows)
    restart(params, optimizers)


@torch.no_grad()
def restart(params: Params, optimizers: Optimizers) -> None:
    """Forget all moments, and that there have been updates."""
    for key, optimizer in optimizers.items():
        for value in optimizer.state.get(params[key], {}).values():
            if isinstance(value, Tensor):
                value.zero_()


def prune_marked(context: DensificationContext, mask: Tensor) -> int:
    """Remove the selected Gaussians and return how many they were."""
    n_pruned = int(mask.sum())
    if n_pruned:
        prune(context.params, context.optimizers, context.state, mask)
    return n_pruned


def summed_over_views(context: DensificationContext, score: Callable[[int], Tensor]) -> Tensor:
    """Add up what a score gives for every training view, in float64."""
    total = score(0).to(torch.float64)
    for index in range(1, context.views.n_views):
        total += score(index)
    return total


def prune_lowest(context: DensificationContext, scores: Tensor, share: float) -> int:
    """Remove the share of Gaussians with the lowest scores, and return how many those were."""
    return prune_marked(context, lowest_share(scores, share).to(context.params["means"].device))


def window(state: State) -> Statistics:
    """Return what the window has collected."""
    blurred, none = state.get("blurred"), torch.zeros_like(state["count"], dtype=torch.bool)
    flags = none if blurred is None else blurred
    return Statistics(state["grad2d"], state["count"], state["views"], dominant_sum=none, blurred=flags)


def clear(state: State) -> None:
    """Start a new window."""
    state["grad2d"].zero_()
    state["count"].zero_()
    state["views"] = 0
    # rows that wait are not those of Gaussians that have been edited
    state["blurred"] = state["dominant_sum"] = state["sh_rest_sum"] = None
    if state["radii"] is not None:
        state["radii"].zero_()


def forget(state: State) -> None:
    """Leave a window behind whose Gaussians are gone."""
    state["grad2d"] = state["count"] = state["radii"] = None
    state["blurred"] = state["dominant_sum"] = state["sh_rest_sum"] = None
    state["views"] = 0
