"""What density control collects of each view, and how it changes the Gaussians: `DensityControl` says when."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pop_fast.density import rows
from pop_fast.density.info import dominant_counts, visible_from_radii, visible_in
from pop_fast.density.protocol import DensificationContext, DensificationStep, Draws, Info, Params, State
from pop_fast.stages.density import SPLIT_CHILDREN, Statistics, blur_set, grow_masks, prune_mask
from pop_fast.stages.polarization import importance_mask, opacity_entropy, pop_loss

if TYPE_CHECKING:
    from pop_fast.density.control import DensityControl


def initialize_state(scene_scale: float, seed: int, count: int) -> State:
    """Return the state before the first step; see `DensityControl.initialize_state`."""
    generator = torch.Generator().manual_seed(seed)
    return {
        "grad2d": None,
        "count": None,
        "views": 0,
        "blurred": None,
        "dominant_sum": None,
        "radii": None,
        "sh_rest_sum": None,
        "scene_scale": float(scene_scale),
        "first_count": count,
        "generator": generator,
    }


def regularizer(plan: DensityControl, opacities: Tensor, state: State, info: Info) -> Tensor:
    """Return the weighted priors on opacities of a view; see `DensityControl.regularizer`."""
    terms = [] if plan.lambda_entropy == 0.0 else [plan.lambda_entropy * opacity_entropy(_logits(opacities))]
    if plan.lambda_pop != 0.0:
        terms.append(plan.lambda_pop * _prior(plan, opacities, state, info))
    return sum(terms[1:], terms[0])


def _logits(opacities: Tensor) -> Tensor:
    # of sigmoid's own output, whose inverse is exact but next to the poles, where entropy does not pull
    return torch.logit(opacities.reshape(-1), eps=torch.finfo(opacities.dtype).eps)


def _prior(plan: DensityControl, opacities: Tensor, state: State, info: Info) -> Tensor:
    mask = importance_mask(dominant_counts(info).sum(0))
    if plan.pop_views == "window" and state["dominant_sum"] is not None:
        mask = mask | importance_mask(state["dominant_sum"])
    visible = visible_in(info, len(mask)) if plan.pop_over == "visible" else None
    return pop_loss(opacities.reshape(-1), mask, visible=visible)


@torch.no_grad()
def collect(plan: DensityControl, params: Params, state: State, step: int, info: Info, packed: bool) -> None:
    """Add what a view has shown to the window's statistics; see `DensityControl.collect`."""
    n = len(params["means"])
    means2d = info[plan.key_for_gradient]
    grads = means2d.absgrad if plan.absgrad else means2d.grad
    if grads is None:
        raise ValueError(f"{plan.key_for_gradient} has no gradient; call step_pre_backward before loss.backward()")
    if state["grad2d"] is None:
        state["grad2d"] = torch.zeros(n, dtype=grads.dtype, device=grads.device)
        state["count"] = torch.zeros(n, dtype=grads.dtype, device=grads.device)
    # pixels -> normalised device coordinates of [-1, 1]; times the cameras, whose mean the loss is
    cameras = int(info["n_cameras"])
    state["views"] += cameras
    unit = grads.new_tensor([0.5 * info["width"] * cameras, 0.5 * info["height"] * cameras])
    norms = torch.linalg.vector_norm(grads * unit, dim=-1)
    if packed:
        ids = info["gaussian_ids"].long()
        state["grad2d"].index_add_(0, ids, norms)
        state["count"].index_add_(0, ids, torch.ones_like(norms))
    else:
        visible = visible_from_radii(info["radii"])
        state["grad2d"].add_(norms.masked_fill_(~visible, 0.0).sum(0))
        state["count"].add_(visible.sum(0))
    if (plan.blur_window == "sum" and plan.collects_blur(step)) or plan.collects_window(step):
        counts = dominant_counts(info).sum(0)
        state["dominant_sum"] = counts if state["dominant_sum"] is None else state["dominant_sum"] + counts
    if plan.collects_blur(step):
        _collect_blur(plan, state, info)
    if plan.refine_scale2d_stop_iter > 0:
        _collect_extents(state, info, packed)


def _collect_blur(plan: DensityControl, state: State, info: Info) -> None:
    # where a mask leaves pixels out, counts and share are of those that it keeps
    kept = info.get("kept_pixels")
    bound = (int(info["width"]), int(info["height"]), plan.theta_blur, plan.blur_min_pixels, kept)
    if plan.blur_window == "sum":
        state["blurred"] = blur_set(state["dominant_sum"], *bound)
        return
    blurred = blur_set(dominant_counts(info), *bound).any(0)
    if plan.blur_window == "any_view" and state["blurred"] is not None:
        blurred |= state["blurred"]
    state["blurred"] = blurred


def draws_of(generator: torch.Generator) -> Draws:
    """Draw from a generator on the CPU."""
    return Draws(
        normals=lambda n: standard_normals(generator, n),
        uniforms=lambda n: torch.rand(n, generator=generator, dtype=torch.float64),
    )


def refine(
    plan: DensityControl, context: DensificationContext, clones: Tensor, splits: Tensor, prunes: Callable[[], Tensor]
) -> DensificationStep:
    """Clone, split, prune, and start a new window.

    Args:
        plan: the strategy.
        context: the Gaussians, and what a step may ask for.
        clones: who is cloned. [N] bool
        splits: who is split. [N] bool
        prunes: asked of the grown set of Gaussians who of it is pruned. -> bool
    """
    n_clones, n_splits = int(clones.sum()), int(splits.sum())
    if n_clones:
        rows.clone(context.params, context.optimizers, context.state, clones)
    if n_splits:
        # a clone of this densification step is never split in it
        padded = torch.cat([splits, splits.new_zeros(n_clones)])
        rows.split(
            context.params,
            context.optimizers,
            context.state,
            padded,
            context.draws.normals(n_splits),
            plan.revised_opacity,
        )
    done = DensificationStep(n_clones, n_splits, prune(context, prunes()))
    clear(context.state)
    if plan.verbose:
        print(f"step {context.step}: {done}, {len(context)} Gaussians")
    return done


def prune(context: DensificationContext, mask: Tensor) -> int:
    """Remove the selected Gaussians and return how many they were."""
    n_pruned = int(mask.sum())
    if n_pruned:
        rows.prune(context.params, context.optimizers, context.state, mask)
    return n_pruned


def planned_growth(plan: DensityControl, context: DensificationContext) -> tuple[Tensor, Tensor]:
    """Return who is cloned and who is split; see `pop_ref.density.grow_masks`. [N] bool each"""
    state = context.state
    masks = grow_masks(window(state), torch.exp(context.params["scales"]), state["scene_scale"], context.step, plan)
    if context.step < plan.refine_scale2d_stop_iter:
        return masks[0], masks[1] | (state["radii"] > plan.grow_scale2d)
    return masks


def window(state: State) -> Statistics:
    """Return what the window has collected."""
    blurred, none = state.get("blurred"), torch.zeros_like(state["count"], dtype=torch.bool)
    return Statistics(
        grad_sum=state["grad2d"],
        n_visible=state["count"],
        n_views=state["views"],
        dominant_sum=none,
        blurred=none if blurred is None else blurred,
    )


def planned_prune(plan: DensityControl, context: DensificationContext) -> Tensor:
    """Return who is too faint or too big; see `pop_ref.density.prune_mask`. [N] bool"""
    opacities, state = torch.sigmoid(context.params["opacities"].flatten()), context.state
    mask = prune_mask(opacities, torch.exp(context.params["scales"]), state["scene_scale"], context.step, plan)
    if plan.prune_too_big_after < context.step < plan.refine_scale2d_stop_iter:
        mask |= state["radii"] > plan.prune_scale2d
    return mask


def reset(plan: DensityControl, context: DensificationContext) -> None:
    """Lower all opacities to the ceiling of a reset."""
    rows.reset_opacities(context.params, context.optimizers, ceiling=plan.reset_opa)


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


def standard_normals(generator: torch.Generator, n: int) -> Tensor:
    """Draw what places the children of n split parents: float32 on the CPU, whatever trains and in what precision.

    Returns:
        Standard normal draws. [2, n, 3]
    """
    return torch.randn((SPLIT_CHILDREN, n, 3), generator=generator, dtype=torch.float32)


def _collect_extents(state: State, info: Info, packed: bool) -> None:
    """Keep the largest extent of each Gaussian, as a share of the longer image side."""
    extents = info["radii"].to(state["grad2d"].dtype) / max(int(info["width"]), int(info["height"]))
    if state["radii"] is None:
        state["radii"] = torch.zeros_like(state["grad2d"])
    if packed:
        largest = extents.amax(-1) if extents.dim() == 2 else extents
        state["radii"].scatter_reduce_(0, info["gaussian_ids"].long(), largest, "amax")
    else:
        largest = extents.amax(-1) if extents.dim() == 3 else extents
        seen = largest.masked_fill(~visible_from_radii(info["radii"]), 0.0)
        torch.maximum(state["radii"], seen.amax(0), out=state["radii"])
