"""Adaptive density control: what 3DGS, gsplat and POP share.

Every step the screen-space gradients are collected; every `refine_every` steps Gaussians that move too much are cloned
(small ones) or split (large ones), and those that are transparent or too big are pruned. POP adds growth by blur and a
term of the loss, gsplat the reset of opacities. Sources: Kerbl et al. 2023 section 5, gsplat 1.5's default strategy for
the order and the attribute names, the POP paper section 3.

A strategy is made where only settings are read, by `pop train --help` for one. So this module does without torch, and
what works on tensors stands in `densify`, which is imported when there are some.
"""

from __future__ import annotations

import warnings
from collections.abc import MutableMapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from pop_fast.density.protocol import (
    DensificationContext,
    DensificationStep,
    Draws,
    Info,
    Optimizers,
    Params,
    State,
    check_layout,
)
from pop_ref.settings import MAX_SH_DEGREE, DensityConfig, PopTerm, ScreenSizeRules, UpdateRules

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.density.passes import Passes

# in a view's `info`: its prior has been asked for
_REGULARIZED = "pop_regularized"
_NEEDED = ("means", "scales", "quats", "opacities")
# steps between a reset and what has to recover from it, and the first one's step, after which large Gaussians are
# pruned (A16); see `DensityControl.scaled`
_RECOVERY = ("reset_every", "pause_refine_after_reset", "prune_too_big_after")
# a shrunk schedule keeps at least so many steps between changes. They are not a share of the schedule: in them a window
# collects enough views to average over, a fresh clone (which starts on top of its source, with no moments) moves away
# from it, and the opacity of what is not needed falls under `prune_opa`. With 20 steps instead, on the fox capture at
# 270 x 480, plain control grew from 12k Gaussians to 87k by step 200, with 100 to 23k
SHORTEST_REFINE_EVERY = 100


@dataclass(frozen=True, kw_only=True)
class DensityControl(DensityConfig, PopTerm, ScreenSizeRules, UpdateRules):
    """Density control with every rule that a method may have; a method is a set of defaults.

    The settings are those of `pop_ref.settings`, named as gsplat's default strategy names them where that has them.

    Attributes:
        absgrad: read `means2d.absgrad` (AbsGS) instead of `means2d.grad`.
        verbose: print a line at every change.
        key_for_gradient: the entry of `info` whose gradient is read.
    """

    # settings that are step numbers, or several of them: what `scaled` multiplies
    scaled_steps: ClassVar[tuple[str, ...]] = (
        *("refine_start_iter", "refine_stop_iter", "blur_start_iter", "blur_stop_iter"),
        *("pop_start_iter", "pop_stop_iter", "refine_scale2d_stop_iter", "sh_start_iter", "opacities_stop_iter"),
        *("means_rewind_iter", "means_rewind_to", "rounds_start_iter", "round_steps", "round_decay_every"),
        "final_prune_iter",
    )

    absgrad: bool = False
    verbose: bool = False
    key_for_gradient: Literal["means2d", "gradient_2dgs"] = "means2d"

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raise ValueError when the parameters or the settings cannot work."""
        check_layout(params, optimizers, _NEEDED)
        if self.refine_every < 1 or self.reset_every < 0:
            raise ValueError(f"refine_every, reset_every are {self.refine_every}, {self.reset_every}; use >= 1, >= 0")

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0, count: int = 0) -> State:
        """Return the state; statistics are allocated at the first step, when the number of Gaussians is known.

        Args:
            scene_scale: the unit of `grow_scale3d` and `prune_scale3d`, world units.
            seed: seeds the random numbers that changes of the Gaussians take.
            count: of the first Gaussians, which some methods measure their budget by.
        """
        from pop_fast.density import densify

        return densify.initialize_state(scene_scale, seed, count)

    def scaled(self, factor: float) -> Self:
        """Return the same settings on a schedule `factor` times as long.

        Every step number is multiplied. `refine_every` is too, but not to under `SHORTEST_REFINE_EVERY` or what it is,
        whichever is less: a shorter schedule has fewer changes, not more hasty ones. Resets come no faster either: what
        one takes away has to be regrown in steps, and those do not get shorter with the schedule. Large Gaussians are
        pruned only after the first reset, as in gsplat, so that step is no sooner either.
        """
        changed: dict[str, Any] = {name: _scaled(getattr(self, name), factor) for name in self.scaled_steps}
        changed |= {name: max(_scaled(getattr(self, name), factor), getattr(self, name)) for name in _RECOVERY}
        floor = min(SHORTEST_REFINE_EVERY, self.refine_every)
        return replace(self, **changed, refine_every=max(round(self.refine_every * factor), floor))

    @property
    def adam_restarts(self) -> tuple[int, ...]:
        """Return the steps after which Adam begins anew."""
        return ()

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step: by the POP loss, the blur rule or a window."""
        prior = self.lambda_pop != 0.0 and self.regularizes(step)
        return prior or self.collects_blur(step) or self.collects_window(step)

    def needs_passes(self, step: int) -> bool:
        """Tell whether the change after this step looks at the training views."""
        return False

    def regularizes(self, step: int) -> bool:
        """Tell whether `regularizer` adds a prior on opacities at this step."""
        weighs = self.lambda_pop != 0.0 or self.lambda_entropy != 0.0
        return weighs and self.pop_start_iter <= step < self.pop_stop_iter

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
        """Tell whether the Gaussians are edited after this step."""
        return self.is_refine_step(step) or self.is_reset_step(step) or step == self.final_prune_iter

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return `lambda_pop L_pop` of this view, with `lambda_entropy` times the entropy, or None when both are off.

        Args:
            opacities: activated opacities, in the graph. [N]
            state: the strategy's state.
            step: counts from 0.
            info: what `rasterization()` returned last; its `dominant_counts` decide who is important.
        """
        if not self.regularizes(step):
            return None
        from pop_fast.density import densify

        if isinstance(info, MutableMapping):
            info[_REGULARIZED] = True
        return densify.regularizer(self, opacities, state, info)

    def is_blur_step(self, step: int) -> bool:
        """Tell whether the change after this step looks at blur."""
        from pop_fast.stages.density import blurs_at

        return self.is_refine_step(step) and blurs_at(step, self)

    def is_refine_step(self, step: int) -> bool:
        """Tell whether the Gaussians change after this step."""
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

    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info, packed: bool = False
    ) -> DensificationStep | None:
        """Collect statistics; at a refine step grow, prune and start a new window; at a reset step reset.

        Returns:
            What happened to the Gaussians, or None where this is no step at which they change.

        Warns:
            UserWarning: the loss of this step should have had the term of `regularizer`, which nobody has asked for.
        """
        if self.regularizes(step) and _REGULARIZED not in info:
            warnings.warn(
                f"{type(self).__name__} trains without its prior on opacities: add strategy.regularizer(torch.sigmoid("
                "params['opacities']), state, step, info), where it is not None, to the loss, or set lambda_pop=0",
                stacklevel=2,
            )
        self.collect(params, state, step, info, packed)
        return self.change(params, optimizers, state, step)

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
            from pop_fast.density import densify

            densify.collect(self, params, state, step, info, packed)

    def change(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        draws: Draws | None = None,
        passes: Passes | None = None,
        sh_degree: int = MAX_SH_DEGREE,
    ) -> DensificationStep | None:
        """Do what is due after a step whose statistics are collected.

        Args:
            params: raw parameters, replaced under their keys.
            optimizers: one per key.
            state: the strategy's state.
            step: counts from 0.
            draws: random numbers; None takes them from the state's generator.
            passes: over the training views, which some methods look at.
            sh_degree: colour bands that those are drawn with.

        Returns:
            What happened, or None where nothing is due.

        Raises:
            ValueError: the method needs passes, and there are none.
        """
        if not self.changes_after(step):
            return None
        import torch

        from pop_fast.density import densify

        draws = draws or densify.draws_of(state["generator"])
        with torch.no_grad():
            return self.edit(DensificationContext(params, optimizers, state, step, draws, passes, sh_degree))

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Do what is due after a step after which the Gaussians change: refine, reset, prune for the last time."""
        done = self.refine(context) if self.is_refine_step(context.step) else DensificationStep()
        return self.prune_finally(context, self.reset(context, done))

    def refine(self, context: DensificationContext) -> DensificationStep:
        """Clone, split and prune by the window's statistics."""
        from pop_fast.density import densify

        return densify.refine(
            self, context, *densify.planned_growth(self, context), lambda: densify.planned_prune(self, context)
        )

    def prune_finally(self, context: DensificationContext, done: DensificationStep) -> DensificationStep:
        """Prune faint Gaussians once more if it is time, and say so in what was done."""
        if context.step != self.final_prune_iter:
            return done
        import torch

        from pop_fast.density import densify

        faint = torch.sigmoid(context.params["opacities"].flatten()) < self.final_prune_opa
        return replace(done, pruned=done.pruned + densify.prune(context, faint))

    def reset(self, context: DensificationContext, done: DensificationStep) -> DensificationStep:
        """Reset opacities if it is time, and say so in what was done."""
        if not self.is_reset_step(context.step):
            return done
        from pop_fast.density import densify

        densify.reset(self, context)
        return replace(done, reset=True)


def _scaled(step: Any, factor: float) -> Any:
    if isinstance(step, tuple):
        return tuple(_scaled(one, factor) for one in step)
    # -1 is no step but "never"
    return max(round(step * factor), 1) if step > 0 else step
