"""Adaptive density control: what 3DGS, gsplat and POP share.

Every step the screen-space gradients are collected; every `refine_every` steps Gaussians that move too much are cloned
(small ones) or split (large ones), and those that are transparent or too big are pruned. POP adds growth by blur and a
term of the loss, gsplat the reset of opacities. Sources: Kerbl et al. 2023 section 5, gsplat 1.5's default strategy for
the order and the attribute names, the POP paper section 3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self

import torch
from torch import Tensor

from pop_fast.density import SPLIT_CHILDREN, Statistics, blur_set, blurs_at, grow_masks, prune_mask
from pop_fast.polarization import importance_mask, pop_loss
from pop_fast.strategies import ops
from pop_fast.strategies.base import Info, Normals, Optimizers, Params, State, StepEvent, check_layout
from pop_fast.strategies.info import dominant_counts, visible_from_radii, visible_in
from pop_ref.settings import DensityConfig, PopTerm, ScreenSizeRules

_NEEDED = ("means", "scales", "quats", "opacities")
_STEPS = ("prune_too_big_after", "refine_start_iter", "refine_stop_iter", "blur_start_iter", "blur_stop_iter")
_MORE_STEPS = ("pop_start_iter", "pop_stop_iter", "refine_scale2d_stop_iter")
# steps between a reset and what it has to be recovered from by; see `DensityControl.scaled`
_RECOVERY = ("reset_every", "pause_refine_after_reset")
# a shrunk schedule keeps at least so many steps between changes. They are not a share of the schedule: in them a window
# collects enough views to average over, a fresh clone (which starts on top of its source, with no moments) moves away
# from it, and the opacity of what is not needed falls under `prune_opa`. With 20 steps instead, on the fox capture at
# 270 x 480, plain control grew from 12k Gaussians to 87k by step 200, with 100 to 23k
SHORTEST_REFINE_EVERY = 100


@dataclass(frozen=True, kw_only=True)
class DensityControl(DensityConfig, PopTerm, ScreenSizeRules):
    """Density control with every rule that a method may have; a method is a set of defaults.

    The settings are those of `pop_ref.settings`, named as gsplat's default strategy names them where that has them.

    Attributes:
        absgrad: read `means2d.absgrad` (AbsGS) instead of `means2d.grad`.
        verbose: print a line at every change.
        key_for_gradient: the entry of `info` whose gradient is read.
    """

    absgrad: bool = False
    verbose: bool = False
    key_for_gradient: Literal["means2d", "gradient_2dgs"] = "means2d"

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raise ValueError when the parameters or the settings cannot work."""
        check_layout(params, optimizers, _NEEDED)
        if self.refine_every < 1 or self.reset_every < 0:
            raise ValueError(f"refine_every, reset_every are {self.refine_every}, {self.reset_every}; use >= 1, >= 0")

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0) -> State:
        """Return the state; statistics are allocated at the first step, when the number of Gaussians is known.

        Args:
            scene_scale: the unit of `grow_scale3d` and `prune_scale3d`, world units.
            seed: seeds the noise that places the children of a split.
        """
        generator = torch.Generator().manual_seed(seed)
        return {
            "grad2d": None,
            "count": None,
            "views": 0,
            "blurred": None,
            "dominant_sum": None,
            "radii": None,
            "scene_scale": float(scene_scale),
            "generator": generator,
        }

    def scaled(self, factor: float) -> Self:
        """Return the same settings on a schedule `factor` times as long.

        Every step number is multiplied. `refine_every` is too, but not to under `SHORTEST_REFINE_EVERY` or what it is,
        whichever is less: a shorter schedule has fewer changes, not more hasty ones. Resets come no faster either: what
        one takes away has to be regrown in steps, and those do not get shorter with the schedule.
        """
        changed = {name: _scaled(getattr(self, name), factor) for name in (*_STEPS, *_MORE_STEPS)}
        changed |= {name: max(_scaled(getattr(self, name), factor), getattr(self, name)) for name in _RECOVERY}
        floor = min(SHORTEST_REFINE_EVERY, self.refine_every)
        return replace(self, **changed, refine_every=max(round(self.refine_every * factor), floor))

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step: by the POP loss, the blur rule or a window."""
        return self.regularizes(step) or self.collects_blur(step) or self.collects_window(step)

    def regularizes(self, step: int) -> bool:
        """Tell whether `regularizer` adds the POP loss at this step."""
        return self.lambda_pop != 0.0 and self.pop_start_iter <= step < self.pop_stop_iter

    def collects(self, step: int) -> bool:
        """Tell whether screen gradients are collected at this step."""
        return step < self.refine_stop_iter

    def collects_blur(self, step: int) -> bool:
        """Tell whether the blur flags of the window are collected at this step."""
        return self.collects(step) and step <= self.blur_stop_iter

    def collects_window(self, step: int) -> bool:
        """Tell whether the dominated pixels of the window are summed for the POP loss at this step."""
        return self.collects(step) and self.pop_views == "window"

    def changes_after(self, step: int) -> bool:
        """Tell whether the population is edited after this step."""
        return self.is_refine_step(step) or self.is_reset_step(step)

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return `lambda_pop * L_pop` of this view, or None when the term is off.

        Args:
            opacities: activated opacities, in the graph. [N]
            state: the strategy's state.
            step: counts from 0.
            info: what `rasterization()` returned last; its `dominant_counts` decide who is important.
        """
        if not self.regularizes(step):
            return None
        mask = importance_mask(dominant_counts(info).sum(0))
        if self.pop_views == "window" and state["dominant_sum"] is not None:
            mask = mask | importance_mask(state["dominant_sum"])
        visible = visible_in(info, len(mask)) if self.pop_over == "visible" else None
        return self.lambda_pop * pop_loss(opacities.reshape(-1), mask, visible=visible)

    def is_blur_step(self, step: int) -> bool:
        """Tell whether the change after this step looks at blur."""
        return self.is_refine_step(step) and blurs_at(step, self)

    def is_refine_step(self, step: int) -> bool:
        """Tell whether the population changes after this step."""
        paused = self.reset_every > 0 and step % self.reset_every < self.pause_refine_after_reset
        return self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0 and not paused

    def is_reset_step(self, step: int) -> bool:
        """Tell whether opacities are reset after this step."""
        due = self.reset_every > 0 and step % self.reset_every == 0 and step < self.refine_stop_iter
        return due and (step > 0 or self.reset_at_zero)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info) -> None:
        """Ask autograd to keep the gradient of the screen centres."""
        if self.key_for_gradient not in info:
            raise ValueError(f"info has no {self.key_for_gradient!r}; pass the dict that rasterization() returns last")
        if self.collects(step):
            info[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info, packed: bool = False
    ) -> StepEvent | None:
        """Collect statistics; at a refine step grow, prune and start a new window; at a reset step reset.

        Returns:
            What happened to the population, or None where this is no step at which it changes.
        """
        self.collect(params, state, step, info, packed)
        return self.change(params, optimizers, state, step)

    @torch.no_grad()
    def collect(self, params: Params, state: State, step: int, info: Info, packed: bool = False) -> None:
        """Add what a view has shown to the window's statistics, which lie in `state`; none from `refine_stop_iter` on.

        Args:
            params: raw parameters, after the optimizers' step.
            state: the strategy's state.
            step: counts from 0.
            info: what `rasterization()` returned last, after the backward pass.
            packed: whether its rows are those of visible Gaussians alone.
        """
        if self.collects(step):
            self._collect(params, state, step, info, packed)

    @torch.no_grad()
    def change(
        self, params: Params, optimizers: Optimizers, state: State, step: int, normals: Normals | None = None
    ) -> StepEvent | None:
        """Do what is due after a step whose statistics are collected.

        Args:
            params: raw parameters, replaced under their keys.
            optimizers: one per key.
            state: the strategy's state.
            step: counts from 0.
            normals: draws that place the children of a split; None takes them from the state's generator.

        Returns:
            What happened, or None where nothing is due.
        """
        if not self.changes_after(step):
            return None
        event = StepEvent()
        if self.is_refine_step(step):
            draws = normals or (lambda n: standard_normals(state["generator"], n))
            cloned, split = self._grow(params, optimizers, state, step, draws)
            event = StepEvent(cloned, split, self._prune(params, optimizers, state, step))
            self._clear(state)
            if self.verbose:
                print(f"step {step}: {event}, {len(params['means'])} Gaussians")
        if self.is_reset_step(step):
            ops.reset_opacities(params, optimizers, ceiling=self.reset_opa)
            event = replace(event, reset=True)
        return event

    def _collect(self, params: Params, state: State, step: int, info: Info, packed: bool) -> None:
        n = len(params["means"])
        means2d = info[self.key_for_gradient]
        grads = means2d.absgrad if self.absgrad else means2d.grad
        if grads is None:
            raise ValueError(f"{self.key_for_gradient} has no gradient; call step_pre_backward before loss.backward()")
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
        if (self.blur_window == "sum" and self.collects_blur(step)) or self.collects_window(step):
            counts = dominant_counts(info).sum(0)
            state["dominant_sum"] = counts if state["dominant_sum"] is None else state["dominant_sum"] + counts
        if self.collects_blur(step):
            self._collect_blur(state, info)
        if self.refine_scale2d_stop_iter > 0:
            _collect_extents(state, info, packed)

    def _collect_blur(self, state: State, info: Info) -> None:
        # where a mask leaves pixels out, counts and share are of those that it keeps
        kept = info.get("kept_pixels")
        bound = (int(info["width"]), int(info["height"]), self.theta_blur, self.blur_min_pixels, kept)
        if self.blur_window == "sum":
            state["blurred"] = blur_set(state["dominant_sum"], *bound)
            return
        blurred = blur_set(dominant_counts(info), *bound).any(0)
        if self.blur_window == "any_view" and state["blurred"] is not None:
            blurred |= state["blurred"]
        state["blurred"] = blurred

    def _grow(
        self, params: Params, optimizers: Optimizers, state: State, step: int, normals: Normals
    ) -> tuple[int, int]:
        clones, splits = self._grow_masks(params, state, step)
        n_clones, n_splits = int(clones.sum()), int(splits.sum())
        if n_clones:
            ops.clone(params, optimizers, state, clones)
        if n_splits:
            # a clone of this event is never split in it
            padded = torch.cat([splits, splits.new_zeros(n_clones)])
            ops.split(params, optimizers, state, padded, normals(n_splits), self.revised_opacity)
        return n_clones, n_splits

    def _grow_masks(self, params: Params, state: State, step: int) -> tuple[Tensor, Tensor]:
        blurred = state.get("blurred")
        none = torch.zeros_like(state["count"], dtype=torch.bool)
        statistics = Statistics(
            grad_sum=state["grad2d"],
            n_visible=state["count"],
            n_views=state["views"],
            dominant_sum=none,
            blurred=none if blurred is None else blurred,
        )
        clones, splits = grow_masks(statistics, torch.exp(params["scales"]), state["scene_scale"], step, self)
        return clones, splits | (state["radii"] > self.grow_scale2d) if step < self.refine_scale2d_stop_iter else splits

    def _prune_mask(self, params: Params, state: State, step: int) -> Tensor:
        opacities = torch.sigmoid(params["opacities"].flatten())
        mask = prune_mask(opacities, torch.exp(params["scales"]), state["scene_scale"], step, self)
        if self.prune_too_big_after < step < self.refine_scale2d_stop_iter:
            mask |= state["radii"] > self.prune_scale2d
        return mask

    def _prune(self, params: Params, optimizers: Optimizers, state: State, step: int) -> int:
        mask = self._prune_mask(params, state, step)
        n_pruned = int(mask.sum())
        if n_pruned:
            ops.prune(params, optimizers, state, mask)
        return n_pruned

    def _clear(self, state: State) -> None:
        state["grad2d"].zero_()
        state["count"].zero_()
        state["views"] = 0
        state["blurred"] = state["dominant_sum"] = None
        if state["radii"] is not None:
            state["radii"].zero_()


def standard_normals(generator: torch.Generator, n: int) -> Tensor:
    """Draw what places the children of n split parents: float32 on the CPU, whatever trains and in what precision.

    Returns:
        Standard normal draws. [2, n, 3]
    """
    return torch.randn((SPLIT_CHILDREN, n, 3), generator=generator, dtype=torch.float32)


def _scaled(step: int, factor: float) -> int:
    # -1 is no step but "never"
    return round(step * factor) if step > 0 else step


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
