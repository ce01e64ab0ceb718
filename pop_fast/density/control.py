"""Adaptive density control: what 3DGS, gsplat and POP share.

Every step the screen-space gradients are collected; every `refine_every` steps Gaussians that move too much are cloned
(small ones) or split (large ones), and those that are transparent or too big are pruned. POP adds growth by blur and a
term of the loss, gsplat the reset of opacities. Sources: Kerbl et al. 2023 section 5, gsplat 1.5's default strategy for
the order and the attribute names, the POP paper section 3.

A strategy is made where only settings are read, by `pop train --help` for one: torch, which takes a second to load, is
imported by what works on tensors.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, MutableMapping
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
    dominant_counts,
    visible_from_radii,
    visible_in,
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
        import torch

        nothing = dict.fromkeys(("grad2d", "count", "blurred", "dominant_sum", "radii", "sh_rest_sum"))
        generator = torch.Generator().manual_seed(seed)
        own = {"scene_scale": float(scene_scale), "first_count": count, "generator": generator}
        return {**nothing, "views": 0, **own}

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

    def at_rest(self) -> Self:
        """Return the same settings with no change of the Gaussians and no turn of a schedule, for steps after the last.

        A method that has settings of its own for when the Gaussians change leaves those changes out here too.
        """
        never = dict.fromkeys(("refine_stop_iter", "reset_every", "refine_scale2d_stop_iter", "blur_start_iter"), 0)
        never |= dict.fromkeys(("means_rewind_iter", "rounds_start_iter"), 0)
        return replace(self, **never, blur_stop_iter=-1, final_prune_iter=-1, reset_at_zero=False)

    @property
    def adam_restarts(self) -> tuple[int, ...]:
        """Return the steps after which Adam begins anew."""
        return ()

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step: by the POP loss, the blur rule or a window."""
        prior = self.lambda_pop != 0.0 and self.regularizes(step)
        return prior or self.collects_blur(step) or self.collects_window(step)

    def needs_passes(self, step: int) -> bool:
        """Tell whether the change after this step looks at the training views: where Adam begins anew, most do."""
        return step in self.adam_restarts

    def reads_colors(self, step: int) -> bool:
        """Tell whether the change after this step reads or sets colours and does not just copy them with their rows.

        Where processes share the Gaussians out, `params` has no colours at other changes; see `pop_fast.density.rows`.
        A change that looks at the training views reads them. A method of another package is taken to read them at every
        change, unless it says here that it does not.
        """
        return self.needs_passes(step) or not type(self).__module__.startswith("pop_fast.")

    def regularizes(self, step: int) -> bool:
        """Tell whether `regularizer` adds a prior on opacities at this step."""
        weighs = self.lambda_pop != 0.0 or self.lambda_entropy != 0.0
        return weighs and self.pop_start_iter <= step < self.pop_stop_iter

    def collects(self, step: int) -> bool:
        """Tell whether a window's statistics are collected at this step: while a change or the POP loss reads them."""
        read_by_prior = self.pop_views == "window" and step < self.pop_stop_iter
        return read_by_prior or step < self.refine_stop_iter

    def collects_blur(self, step: int) -> bool:
        """Tell whether the blur flags of the window are collected at this step."""
        return self.collects(step) and step <= self.blur_stop_iter

    def collects_window(self, step: int) -> bool:
        """Tell whether the dominated pixels of the window are summed for the POP loss at this step."""
        return self.collects(step) and self.pop_views == "window"

    def changes_after(self, step: int) -> bool:
        """Tell whether the Gaussians are edited after this step."""
        due = self.is_refine_step(step) or self.is_reset_step(step) or self.needs_passes(step)
        return due or step == self.final_prune_iter

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return `lambda_pop L_pop` of this view, with `lambda_entropy` times the entropy, or None when both are off.

        Args:
            opacities: activated opacities, in the graph. [N]
            info: what `rasterization()` returned last; its `dominant_counts` decide which Gaussians are important.
        """
        if not self.regularizes(step):
            return None
        from pop_fast.stages.regularizers import opacity_entropy

        if isinstance(info, MutableMapping):
            info[_REGULARIZED] = True
        terms = [] if self.lambda_entropy == 0.0 else [self.lambda_entropy * opacity_entropy(_logits(opacities))]
        if self.lambda_pop != 0.0:
            terms.append(self.lambda_pop * self._prior(opacities, state, info))
        return sum(terms[1:], terms[0])

    def _prior(self, opacities: Tensor, state: State, info: Info) -> Tensor:
        from pop_fast.stages.regularizers import importance_mask, pop_loss

        mask = importance_mask(dominant_counts(info).sum(0))
        if self.pop_views == "window" and state["dominant_sum"] is not None:
            mask = mask | importance_mask(state["dominant_sum"])
        visible = visible_in(info, len(mask)) if self.pop_over == "visible" else None
        return pop_loss(opacities.reshape(-1), mask, visible=visible)

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

        Args:
            packed: as gsplat's strategies take it; whether rows are packed is read from `info`.

        Returns:
            What happened to the Gaussians, or None where this is no step at which they change.

        Warns:
            UserWarning: the loss of this step should have had the term of `regularizer`, which was never called.
        """
        if self.regularizes(step) and _REGULARIZED not in info:
            warnings.warn(
                f"{type(self).__name__} trains without its prior on opacities: add strategy.regularizer(torch.sigmoid("
                "params['opacities']), state, step, info), where it is not None, to the loss, or set lambda_pop=0",
                stacklevel=2,
            )
        self.collect(params, state, step, info)
        return self.change(params, optimizers, state, step)

    def collect(self, params: Params, state: State, step: int, info: Info) -> None:
        """Add what a view has shown to the window's statistics, which lie in `state`, where `collects` says so.

        Args:
            params: raw parameters, after the optimizers' step.
            info: what `rasterization()` returned last, after the backward pass.

        Raises:
            ValueError: the screen centres have no gradient, or no absolute one where `absgrad` reads it.
        """
        if self.collects(step):
            import torch

            with torch.no_grad():
                self._collect(params, state, step, info)

    def _collect(self, params: Params, state: State, step: int, info: Info) -> None:
        import torch

        n, packed = len(params["means"]), info.get("gaussian_ids") is not None
        means2d = info[self.key_for_gradient]
        if self.absgrad and not hasattr(means2d, "absgrad"):
            raise ValueError(f"{self.key_for_gradient} has no absgrad, which is read here; render with absgrad=True")
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
        from pop_fast.stages.density import blur_set

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
            draws: random numbers; None takes them from the state's generator.
            sh_degree: colour bands that those are drawn with.

        Returns:
            What happened, or None where nothing is due.

        Raises:
            ValueError: the method needs passes, and there are none.
        """
        if not self.changes_after(step):
            return None
        import torch

        draws = draws or Draws.of(state["generator"])
        with torch.no_grad():
            context = DensificationContext(params, optimizers, state, step, draws, passes, sh_degree)
            done = self.prune_finally(context, self.edit(context))
        if self.verbose:
            print(f"step {step}: {done}, {len(context)} Gaussians")
        return done

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Do what is due after a step after which the Gaussians change, before the last prune: refine, reset."""
        done = self.refine(context) if self.is_refine_step(context.step) else DensificationStep()
        return self.reset(context, done)

    def refine(self, context: DensificationContext) -> DensificationStep:
        """Clone, split and prune by the window's statistics."""
        return self.densify(context, *self.planned_growth(context), lambda: self.planned_prune(context))

    def densify(
        self, context: DensificationContext, clones: Tensor, splits: Tensor, prunes: Callable[[], Tensor]
    ) -> DensificationStep:
        """Clone, split, prune, and start a new window.

        Args:
            clones: which Gaussians are cloned. [N] bool
            splits: which are split. [N] bool
            prunes: given the grown set of Gaussians, tells which are pruned. -> bool
        """
        import torch

        from pop_fast.density import rows

        n_clones, n_splits = int(clones.sum()), int(splits.sum())
        edited = (context.params, context.optimizers, context.state)
        if n_clones:
            rows.clone(*edited, clones)
        if n_splits:
            # a clone of this densification step is never split in it
            padded = torch.cat([splits, splits.new_zeros(n_clones)])
            rows.split(*edited, padded, context.draws.normals(n_splits), self.revised_opacity)
        done = DensificationStep(n_clones, n_splits, rows.prune_marked(context, prunes()))
        rows.clear(context.state)
        return done

    def planned_growth(self, context: DensificationContext) -> tuple[Tensor, Tensor]:
        """Return which Gaussians are cloned and which are split; see `pop_ref.density.grow_masks`. [N] bool each"""
        from pop_fast.density.rows import window
        from pop_fast.stages.density import grow_masks

        state = context.state
        masks = grow_masks(window(state), context.params["scales"].exp(), state["scene_scale"], context.step, self)
        if context.step < self.refine_scale2d_stop_iter:
            return masks[0], masks[1] | (state["radii"] > self.grow_scale2d)
        return masks

    def planned_prune(self, context: DensificationContext) -> Tensor:
        """Return which Gaussians are too faint or too big; see `pop_ref.density.prune_mask`. [N] bool"""
        from pop_fast.stages.density import prune_mask

        opacities, state = context.params["opacities"].flatten().sigmoid(), context.state
        mask = prune_mask(opacities, context.params["scales"].exp(), state["scene_scale"], context.step, self)
        if self.prune_too_big_after < context.step < self.refine_scale2d_stop_iter:
            mask |= state["radii"] > self.prune_scale2d
        return mask

    def prune_finally(self, context: DensificationContext, done: DensificationStep) -> DensificationStep:
        """Prune faint Gaussians once more if it is time, and say so in what was done."""
        if context.step != self.final_prune_iter:
            return done
        from pop_fast.density.rows import prune_marked

        faint = context.params["opacities"].flatten().sigmoid() < self.final_prune_opa
        return replace(done, pruned=done.pruned + prune_marked(context, faint))

    def reset(self, context: DensificationContext, done: DensificationStep) -> DensificationStep:
        """Lower all opacities to the ceiling of a reset if it is time, and say so in what was done."""
        if not self.is_reset_step(context.step):
            return done
        from pop_fast.density.rows import reset_opacities

        reset_opacities(context.params, context.optimizers, ceiling=self.reset_opa)
        return replace(done, reset=True)


def _logits(opacities: Tensor) -> Tensor:
    import torch

    # of sigmoid's own output, whose inverse is exact but next to the poles, where entropy does not pull
    return torch.logit(opacities.reshape(-1), eps=torch.finfo(opacities.dtype).eps)


def _collect_extents(state: State, info: Info, packed: bool) -> None:
    """Keep the largest extent of each Gaussian, as a share of the longer image side."""
    import torch

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


def _scaled(step: Any, factor: float) -> Any:
    if isinstance(step, tuple):
        return tuple(_scaled(one, factor) for one in step)
    # -1 is no step but "never"
    return max(round(step * factor), 1) if step > 0 else step
