"""Adaptive density control: what 3DGS, gsplat and POP share.

Every step the screen-space gradients are collected; every `refine_every` steps Gaussians that move too much are cloned
(small ones) or split (large ones), and those that are transparent or too big are pruned. Sources: Kerbl et al. 2023
section 5, gsplat 1.5's default strategy for the numbers, the order and the attribute names.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from pop_fast.density import SPLIT_CHILDREN, Statistics, grow_masks, prune_mask
from pop_fast.strategies import ops
from pop_fast.strategies.base import Info, Optimizers, Params, State, check_layout

_NEEDED = ("means", "scales", "quats", "opacities")
_STEPS = ("prune_too_big_after", "refine_start_iter", "refine_stop_iter", "reset_every", "pause_refine_after_reset")
# a shrunk schedule keeps at least so many steps between changes. They are not a share of the schedule: in them a window
# collects enough views to average over, a fresh clone (which starts on top of its source, with no moments) moves away
# from it, and the opacity of what is not needed falls under `prune_opa`. With 20 steps instead, on the fox capture at
# 270 x 480, plain control grew from 12k Gaussians to 87k by step 200, with 100 to 23k
SHORTEST_REFINE_EVERY = 100


@dataclass(kw_only=True)
class DensityControl:
    """Settings of adaptive density control, named as gsplat's default strategy names them.

    Attributes:
        prune_opa: opacity under which a Gaussian is pruned.
        grow_grad2d: mean screen gradient, in units of half an image, over which a Gaussian grows.
        grad_denominator: that mean is over the "visible_views" of the window, as all code does, or over the whole
            "window", as the formula is printed.
        grow_scale3d: largest axis, in scene scales, up to which a Gaussian is cloned and over which it is split.
        prune_scale3d: largest axis, in scene scales, over which a Gaussian is pruned.
        prune_too_big: whether that rule applies at all.
        prune_too_big_after: step after which it applies.
        refine_start_iter: step after which the population changes.
        refine_stop_iter: step from which nothing is collected and nothing changes.
        refine_every: steps between changes.
        reset_every: steps between opacity resets; 0 never resets.
        reset_opa: what a reset lowers opacities to; gsplat couples it to `prune_opa`, as twice that.
        reset_at_zero: also reset at step 0, as gsplat 1.1 to 1.5.2 did.
        pause_refine_after_reset: steps after a reset in which the population stays.
        inclusive: grow at `>=` (3DGS) instead of `>` (gsplat).
        absgrad: read `means2d.absgrad` (AbsGS) instead of `means2d.grad`.
        revised_opacity: children of a split get `1 - sqrt(1 - o)` instead of `o`.
        verbose: print a line at every change.
        key_for_gradient: the entry of `info` whose gradient is read.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grad_denominator: Literal["visible_views", "window"] = "visible_views"
    grow_scale3d: float = 0.01
    prune_scale3d: float = 0.1
    prune_too_big: bool = True
    prune_too_big_after: int = 3000
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    refine_every: int = 100
    reset_every: int = 0
    reset_opa: float = 0.01
    reset_at_zero: bool = False
    pause_refine_after_reset: int = 0
    inclusive: bool = False
    absgrad: bool = False
    revised_opacity: bool = False
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
            "scene_scale": float(scene_scale),
            "generator": generator,
            "event": None,
        }

    def scaled(self, factor: float) -> Any:
        """Return the same settings on a schedule `factor` times as long.

        Every step number is multiplied. `refine_every` is too, but not to under `SHORTEST_REFINE_EVERY` or what it is,
        whichever is less: a shorter schedule has fewer changes, not more hasty ones.
        """
        changed = {name: round(getattr(self, name) * factor) for name in (*_STEPS, *self._more_steps())}
        floor = min(SHORTEST_REFINE_EVERY, self.refine_every)
        return replace(self, **changed, refine_every=max(round(self.refine_every * factor), floor))

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step, so that a trainer can spare the work."""
        return False

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return the term that the method adds to the loss: none."""
        return None

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
        if step < self.refine_stop_iter:
            info[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info, packed: bool = False
    ) -> None:
        """Collect statistics; at a refine step grow, prune and start a new window; at a reset step reset.

        What happened is left in `state["event"]`: a dict that counts Gaussians cloned, split and pruned, or None.
        """
        state["event"] = None
        if step >= self.refine_stop_iter:
            return
        self._collect(params, state, step, info, packed)
        self.change(params, optimizers, state, step)

    @torch.no_grad()
    def change(self, params: Params, optimizers: Optimizers, state: State, step: int) -> None:
        """Do what is due after a step whose statistics are collected; for trainers that collect them themselves.

        What happened is left in `state["event"]`, as by `step_post_backward`.
        """
        state["event"] = None
        if self.is_refine_step(step):
            state["event"] = self._grow(params, optimizers, state, step)
            state["event"]["pruned"] = self._prune(params, optimizers, state, step)
            self._clear(state)
            if self.verbose:
                print(f"step {step}: {state['event']}, {len(params['means'])} Gaussians")
        if self.is_reset_step(step):
            ops.reset_opacities(params, optimizers, ceiling=self.reset_opa)
            state["event"] = {**(state["event"] or {"cloned": 0, "split": 0, "pruned": 0}), "reset": True}

    def draws(self, state: State, n: int, like: Tensor) -> Tensor:
        """Return standard normal draws for the children of `n` split Gaussians, from the state's generator. [2, n, 3]

        Args:
            state: the strategy's state.
            n: how many are split.
            like: a tensor of the type and on the device that the draws are for.
        """
        generator = state["generator"]
        shape = (SPLIT_CHILDREN, n, 3)
        return torch.randn(shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)

    def _more_steps(self) -> tuple[str, ...]:
        return ()

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

    def _grow(self, params: Params, optimizers: Optimizers, state: State, step: int) -> dict[str, Any]:
        clones, splits = self._grow_masks(params, state, step)
        n_clones, n_splits = int(clones.sum()), int(splits.sum())
        if n_clones:
            ops.clone(params, optimizers, state, clones)
        if n_splits:
            # a clone of this event is never split in it
            padded = torch.cat([splits, splits.new_zeros(n_clones)])
            normals = self.draws(state, n_splits, params["means"])
            ops.split(params, optimizers, state, padded, normals, self.revised_opacity)
        return {"cloned": n_clones, "split": n_splits}

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
        return grow_masks(statistics, torch.exp(params["scales"]), state["scene_scale"], step, self)

    def _prune_mask(self, params: Params, state: State, step: int) -> Tensor:
        opacities = torch.sigmoid(params["opacities"].flatten())
        return prune_mask(opacities, torch.exp(params["scales"]), state["scene_scale"], step, self)

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


def visible_from_radii(radii: Tensor) -> Tensor:
    """Return which Gaussians each camera sees: all extents > 0. [C, N, 2] (or [C, N] before gsplat 1.5) -> [C, N]"""
    return (radii > 0).all(-1) if radii.dim() == 3 else radii > 0
