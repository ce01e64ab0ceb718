"""POP: growth by gradient or by blur, the Polarized Opacity Prior, and no opacity reset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from pop_fast.density import blur_set, blurs_at
from pop_fast.polarization import importance_mask, pop_loss
from pop_fast.strategies.base import Info, Params, State
from pop_fast.strategies.control import DensityControl, visible_from_radii


@dataclass(kw_only=True)
class POPStrategy(DensityControl):
    """Density control of the POP paper, with the reading of every open question as a setting.

    A Gaussian grows when its screen gradient is large (as in gsplat) or, from `blur_start_iter` to `blur_stop_iter`,
    when it is the dominant Gaussian of more than `theta_blur * H * W` pixels of a view. Opacities are never reset.
    Instead `regularizer` adds `lambda_pop * L_pop` to the loss, which pushes the opacities of Gaussians that dominate a
    pixel to 1 and the others to 0. A trainer other than ours adds that term itself:

        loss = loss + strategy.regularizer(torch.sigmoid(params["opacities"]), state, step, info)

    Attributes:
        reset_every: 0, never; 3000 with `lambda_pop=0` is the paper's "Reset" ablation.
        grow_on_gradient: whether the gradient rule is on beside the blur rule. The paper adds the blur rule to it.
        grow_on_gradient_in_blur_window: and also where the blur rule is, which else works alone there.
        theta_blur: share of a view's pixels over which a dominant Gaussian counts as blur (eq. 6).
        blur_min_pixels: and at least over so many pixels. The paper has no such bound and needs none: its smallest
            images make `theta_blur` 11 pixels. In an image of 130,000 pixels it is 3, and every Gaussian that can be
            seen would be split until it nearly cannot.
        blur_start_iter: first step of the blur rule.
        blur_stop_iter: last step of the blur rule, itself included; under `blur_start_iter` turns the rule off.
        blur_window: what the count is taken over. "any_view": one view since the last change is enough, as in
            Mini-Splatting, of whose threshold the paper's is one tenth. "sum": the counts of those views are added, a
            literal reading of "cumulative". "own_view": the view of the step alone.
        blur_rule: "by_scale" clones small and splits large blur Gaussians, as the paper says; "split" always splits, as
            Mini-Splatting does.
        lambda_pop: weight of the POP loss (eqs. 7, 8); `scaled` divides it by the factor.
        pop_start_iter: first step with the POP loss.
        pop_stop_iter: step from which there is none.
        pop_views: a Gaussian is important when it dominates a pixel of the "current" view, as the paper says, or of
            any view since the last change ("window").
        pop_over: what the loss averages over: "all" Gaussians, as the paper's sums run, or those "visible" in the view.
    """

    theta_blur: float = 2e-5
    blur_min_pixels: float = 0.0
    blur_start_iter: int = 3000
    blur_stop_iter: int = 7000
    blur_window: Literal["any_view", "sum", "own_view"] = "any_view"
    blur_rule: Literal["by_scale", "split"] = "by_scale"
    grow_on_gradient: bool = True
    grow_on_gradient_in_blur_window: bool = True
    lambda_pop: float = 1e-3
    pop_start_iter: int = 0
    pop_stop_iter: int = 15_000
    pop_views: Literal["current", "window"] = "current"
    pop_over: Literal["all", "visible"] = "all"

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0) -> State:
        """Return the state, with the blur flags of the window and, where a setting needs it, its summed counts."""
        return {**super().initialize_state(scene_scale, seed), "blurred": None, "dominant_sum": None}

    def scaled(self, factor: float) -> Any:
        """Return the same settings on a schedule `factor` times as long; see `DensityControl.scaled`.

        `lambda_pop` is divided by the factor, so that the prior's push on an opacity, which adds up over the steps that
        it is on for, is the same in a short schedule and in a long one. With the paper's weight in a tenth of the
        paper's steps the population would stop shrinking a tenth of the way.
        """
        return replace(super().scaled(factor), lambda_pop=self.lambda_pop / factor)

    def is_blur_step(self, step: int) -> bool:
        """Tell whether the change after this step looks at blur."""
        return self.is_refine_step(step) and blurs_at(step, self)

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step: by the POP loss, the blur rule or a window."""
        return self.regularizes(step) or self.collects_blur(step) or self.collects_window(step)

    def theta_in(self, width: int, height: int) -> float:
        """Return the share of a view's pixels over which a dominant Gaussian counts as blur."""
        return max(self.theta_blur, self.blur_min_pixels / (height * width))

    def collects_blur(self, step: int) -> bool:
        """Tell whether the blur flags of the window are collected at this step."""
        return self.collects(step) and step <= self.blur_stop_iter

    def collects_window(self, step: int) -> bool:
        """Tell whether the dominated pixels of the window are summed for the POP loss at this step."""
        return self.collects(step) and self.pop_views == "window"

    def regularizes(self, step: int) -> bool:
        """Tell whether the POP loss is on at this step."""
        return self.lambda_pop != 0.0 and self.pop_start_iter <= step < self.pop_stop_iter

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
        visible = self._visible(info, len(mask)) if self.pop_over == "visible" else None
        return self.lambda_pop * pop_loss(opacities.reshape(-1), mask, visible=visible)

    def _visible(self, info: Info, n: int) -> Tensor:
        if info.get("gaussian_ids") is None:
            return visible_from_radii(info["radii"]).any(0)
        visible = torch.zeros(n, dtype=torch.bool, device=info["radii"].device)
        visible[info["gaussian_ids"].long()] = True
        return visible

    def _more_steps(self) -> tuple[str, ...]:
        return ("blur_start_iter", "blur_stop_iter", "pop_start_iter", "pop_stop_iter")

    def _collect(self, params: Params, state: State, step: int, info: Info, packed: bool) -> None:
        super()._collect(params, state, step, info, packed)
        sums = self.blur_window == "sum" and step <= self.blur_stop_iter
        if sums or self.pop_views == "window":
            counts = dominant_counts(info).sum(0)
            state["dominant_sum"] = counts if state["dominant_sum"] is None else state["dominant_sum"] + counts
        if step <= self.blur_stop_iter:
            self._collect_blur(state, info)

    def _collect_blur(self, state: State, info: Info) -> None:
        height, width = int(info["height"]), int(info["width"])
        theta = self.theta_in(width, height)
        if self.blur_window == "sum":
            state["blurred"] = blur_set(state["dominant_sum"], width, height, theta)
            return
        blurred = blur_set(dominant_counts(info), width, height, theta).any(0)
        if self.blur_window == "any_view" and state["blurred"] is not None:
            blurred |= state["blurred"]
        state["blurred"] = blurred

    def _clear(self, state: State) -> None:
        super()._clear(state)
        state["blurred"] = state["dominant_sum"] = None


def dominant_counts(info: Info) -> Tensor:
    """Return how many pixels each Gaussian dominates in each view, [C, N], or say why it cannot be known."""
    counts = info.get("dominant_counts")
    if counts is None:
        raise ValueError(
            "info has no 'dominant_counts', which POP is built on: render with pop_fast.rasterization.rasterization "
            "(a drop-in for gsplat's), or put into info how many pixels, [cameras, Gaussians], each one dominates, "
            "that is, has the largest blending weight at"
        )
    return counts
