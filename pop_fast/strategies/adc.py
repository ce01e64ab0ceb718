"""Plain adaptive density control with opacity reset: 3DGS as gsplat's default strategy runs it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from pop_fast.strategies.base import Info, Params, State
from pop_fast.strategies.control import DensityControl, visible_from_radii


@dataclass(kw_only=True)
class ADCStrategy(DensityControl):
    """Density control with opacity reset at steps 3000, 6000, 9000 and 12000.

    The defaults are those of gsplat before 1.5.3, without its reset at step 0 (1.5.3 itself never resets, by a slip of
    operator precedence that was mended later). `ADCStrategy(inclusive=True)` is 3DGS.

    Attributes:
        reset_every: steps between opacity resets; 0 never resets.
        grow_scale2d: extent, as a share of the longer image side, over which a Gaussian is split.
        prune_scale2d: extent, as a share of the longer image side, over which a Gaussian is pruned.
        refine_scale2d_stop_iter: step until which those two apply; 0, as in gsplat and, in effect, in 3DGS (whose test
            reads radii that it has just cleared), never.
    """

    reset_every: int = 3000
    grow_scale2d: float = 0.05
    prune_scale2d: float = 0.15
    refine_scale2d_stop_iter: int = 0

    # what the rules of growth read besides: gradients always count, and there is no blur rule
    grow_on_gradient: ClassVar[bool] = True
    grow_on_gradient_in_blur_window: ClassVar[bool] = True
    blur_start_iter: ClassVar[int] = 0
    blur_stop_iter: ClassVar[int] = -1
    blur_rule: ClassVar[str] = "by_scale"

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0) -> State:
        """Return the state, with the largest extents seen when they are asked for."""
        return {**super().initialize_state(scene_scale, seed), "radii": None}

    def _more_steps(self) -> tuple[str, ...]:
        return ("refine_scale2d_stop_iter",)

    def _collect(self, params: Params, state: State, step: int, info: Info, packed: bool) -> None:
        super()._collect(params, state, step, info, packed)
        if self.refine_scale2d_stop_iter == 0:
            return
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

    def _clear(self, state: State) -> None:
        super()._clear(state)
        if state["radii"] is not None:
            state["radii"].zero_()

    def _grow_masks(self, params: Params, state: State, step: int) -> tuple[Tensor, Tensor]:
        clones, splits = super()._grow_masks(params, state, step)
        return clones, splits | (state["radii"] > self.grow_scale2d) if step < self.refine_scale2d_stop_iter else splits

    def _prune_mask(self, params: Params, state: State, step: int) -> Tensor:
        mask = super()._prune_mask(params, state, step)
        if self.prune_too_big_after < step < self.refine_scale2d_stop_iter:
            mask |= state["radii"] > self.prune_scale2d
        return mask
