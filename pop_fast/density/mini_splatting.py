"""Mini-Splatting: blur split, points set anew from depth, then importance-weighted sampling and pruning.

Source: Fang and Wang 2024 and its code. Beside 3DGS's growth by gradient, who dominates more than HW / 5000 pixels of
any view since the last densification step is split whatever its size. At steps 5,000 and 10,000 all Gaussians are
replaced by points on the rays of pixels drawn from every training view, where the Gaussian that the pixel belongs to is
densest (`pop_ref.chord`). At 15,000 half of them, drawn by importance, keep place and colour and begin anew; at 20,000
the least important go that make up 1 % of all importance. Opacities are never reset, colours have one band until
15,000, and the positions' rate goes back at 15,000 to what it was at 5,000. Everything else is 3DGS of 2023. The
paper's Mini-Splatting* samples a share of 0.4 on Tanks & Temples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Final, Literal

from pop_fast.density.gsplat import InriaStrategy
from pop_fast.density.protocol import DensificationContext, DensificationStep
from pop_ref.recipes import BASELINES, Recipe

_MINI: Final[Recipe] = BASELINES["Mini-Splatting"]


@dataclass(frozen=True, kw_only=True)
class MiniSplattingStrategy(InriaStrategy):
    """3DGS with blur split, depth re-initialization, sampling and pruning by importance.

    Attributes:
        reinit_iters: steps after which all Gaussians are replaced by points of the training views' depth.
        reinit_points: how many points at most, shared out evenly to the views.
        reinit_opacity: of Gaussians that begin anew.
        sample_iter: step after which Gaussians are drawn by importance.
        sampling_factor: share of those with any importance that is drawn; 0.5 on Mip-NeRF 360, 0.3 on Tanks & Temples
            and Deep Blending.
        prune_iter: step after which the least important are removed.
        prune_mass: share of all importance that these make up.
        importance: "indoor" sums weights over pixels and views, "outdoor" means over the pixels of each view.
        max_gaussians: with so many there is no densification.
    """

    reset_every: int = _MINI.density.reset_every
    theta_blur: float = _MINI.density.theta_blur
    blur_start_iter: int = _MINI.density.blur_start_iter
    blur_stop_iter: int = _MINI.density.blur_stop_iter
    blur_window: Literal["any_view", "sum", "own_view"] = _MINI.density.blur_window
    blur_rule: Literal["by_scale", "split"] = _MINI.density.blur_rule
    sh_start_iter: int = _MINI.updates.sh_start_iter
    means_rewind_iter: int = _MINI.updates.means_rewind_iter
    means_rewind_to: int = _MINI.updates.means_rewind_to
    reinit_iters: tuple[int, ...] = _MINI.adam_restarts[:2]
    reinit_points: int = 3_500_000
    reinit_opacity: float = 0.1
    sample_iter: int = _MINI.adam_restarts[2]
    sampling_factor: float = 0.5
    prune_iter: int = _MINI.adam_restarts[3]
    prune_mass: float = 0.01
    importance: Literal["indoor", "outdoor"] = "indoor"
    max_gaussians: int = 4_500_000
    scaled_steps: ClassVar[tuple[str, ...]] = (
        *InriaStrategy.scaled_steps,
        *("reinit_iters", "sample_iter", "prune_iter"),
    )

    @property
    def adam_restarts(self) -> tuple[int, ...]:
        """Return the steps after which Gaussians are replaced or pruned by importance."""
        return (*self.reinit_iters, self.sample_iter, self.prune_iter)

    def is_refine_step(self, step: int) -> bool:
        """Tell whether Gaussians are cloned and split after this step: not where they are replaced."""
        return super().is_refine_step(step) and step not in self.reinit_iters

    def needs_passes(self, step: int) -> bool:
        """Tell whether the training views are looked at."""
        return step in self.adam_restarts

    def changes_after(self, step: int) -> bool:
        """Tell whether the Gaussians are edited after this step."""
        return super().changes_after(step) or self.needs_passes(step)

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Do what is due after this step."""
        if context.step in self.adam_restarts:
            from pop_fast.density import mini_splatting_steps as events

            if context.step in self.reinit_iters:
                return events.set_anew_from_depth(self, context)
            return (
                events.draw_by_importance(self, context)
                if context.step == self.sample_iter
                else events.prune(self, context)
            )
        if self.is_refine_step(context.step) and len(context) >= self.max_gaussians:
            return DensificationStep()
        return super().edit(context)
