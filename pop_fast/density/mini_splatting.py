"""Mini-Splatting: blur split, points set anew from depth, then importance-weighted sampling and pruning.

Source: Fang and Wang 2024 and its code. 3DGS grows by gradient here too; what dominates more than HW / 5000 pixels of
any view since the last densification step is split whatever its size. At steps 5,000 and 10,000 all Gaussians are
replaced by points on the rays of pixels drawn from every training view, where the Gaussian that the pixel belongs to is
densest (`pop_ref.chord`). At 15,000 half of them, drawn by importance, keep place and colour and begin anew; at 20,000
the least important go that make up 1 % of all importance. Opacities are never reset, colours have one band until
15,000, and the positions' rate goes back at 15,000 to what it was at 5,000. Everything else is 3DGS of 2023. The
paper's Mini-Splatting* samples a share of 0.4 on Tanks & Temples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from pop_fast.density.gsplat import InriaStrategy
from pop_fast.density.protocol import DensificationContext, DensificationStep, Params
from pop_ref.recipes import BASELINES, Recipe

if TYPE_CHECKING:
    from torch import Tensor

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
            if context.step in self.reinit_iters:
                return self._set_anew_from_depth(context)
            is_draw = context.step == self.sample_iter
            return self._draw_by_importance(context) if is_draw else self._prune_by_importance(context)
        if self.is_refine_step(context.step) and len(context) >= self.max_gaussians:
            return DensificationStep()
        return super().edit(context)

    def _set_anew_from_depth(self, context: DensificationContext) -> DensificationStep:
        """Replace all Gaussians by points of the training views, with their pixels' colours."""
        import torch

        from pop_fast.data.gaussians import SH_C0

        points, colors = [], []
        for index in range(context.views.n_views):
            found, color = self._points_of_view(context, index)
            points.append(found)
            colors.append(color)
        sh0 = ((torch.cat(colors) - 0.5) / SH_C0)[:, None]
        return self._begin_anew(context, torch.cat(points), sh0)

    def _points_of_view(self, context: DensificationContext, index: int) -> tuple[Tensor, Tensor]:
        """Draw pixels by their opacity, and return their points and their photograph's colours. [M, 3] each"""
        import torch

        from pop_fast.stages.mini_splatting import samples_per_view
        from pop_fast.stages.selection import sample_without_replacement

        views = context.views
        points, ids, T_final = views.dominant_points(context.params, index, context.sh_degree)
        height, width = ids.shape
        mask = views.view(index).mask
        shown = ids >= 0 if mask is None else (ids >= 0) & mask.to(ids.device)
        weights = torch.where(shown, 1.0 - T_final, 0.0).flatten().to("cpu", torch.float64)
        wanted = samples_per_view(views.n_views, width, height, self.reinit_points)
        wanted = min(wanted, int((weights > 0.0).sum()))
        drawn = sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights))).to(points.device)
        photo = views.photo(index).reshape(-1, 3).to(points.device)
        return points.reshape(-1, 3)[drawn], photo[drawn].to(points.dtype) / 255.0

    def _importances(self, context: DensificationContext) -> Tensor:
        """Sum the importance of every Gaussian over the training views; 0 where none is dominated at any pixel. [N]"""
        import torch

        from pop_fast.stages.mini_splatting import view_importance

        n = len(context)
        total, dominant_sum = torch.zeros(n, dtype=torch.float64), torch.zeros(n, dtype=torch.int64)
        for index in range(context.views.n_views):
            found = context.views.contributions(context.params, index, context.sh_degree)
            scores = view_importance(found, found.dominant_counts, self.importance == "outdoor")
            total += scores.to("cpu", torch.float64)
            dominant_sum += found.dominant_counts.cpu()
        return torch.where(dominant_sum > 0, total, 0.0)

    def _draw_by_importance(self, context: DensificationContext) -> DensificationStep:
        """Let a share of the Gaussians, drawn by importance, keep place and colour and begin anew; the others go."""
        from pop_fast.stages.selection import sample_without_replacement

        weights = self._importances(context)
        wanted = int(self.sampling_factor * int((weights > 0.0).sum()))
        drawn = sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))
        drawn = drawn.to(context.params["means"].device)
        return self._begin_anew(context, context.params["means"].detach()[drawn], context.params["sh0"].detach()[drawn])

    def _prune_by_importance(self, context: DensificationContext) -> DensificationStep:
        """Remove the least important Gaussians, and start Adam anew."""
        from pop_fast.density.rows import prune_marked, restart
        from pop_fast.stages.selection import least_mass

        mask = least_mass(self._importances(context), self.prune_mass)
        pruned = prune_marked(context, mask.to(context.params["means"].device))
        restart(context.params, context.optimizers)
        return DensificationStep(pruned=pruned)

    def _begin_anew(self, context: DensificationContext, points: Tensor, sh0: Tensor) -> DensificationStep:
        """Let Gaussians of points take the place of all there are."""
        from pop_fast.density.rows import forget, replace_rows

        forget(context.state)
        made = _rows(context.params, points, sh0, self.reinit_opacity)
        replace_rows(context.params, context.optimizers, context.state, made)
        return DensificationStep(replaced=len(points))


def _rows(params: Params, points: Tensor, sh0: Tensor, opacity: float) -> Mapping[str, Tensor]:
    """Make raw parameters of points: spheres as large as the way to their neighbours, bands beyond the first 0."""
    import torch

    from pop_fast.stages.mini_splatting import nearest_log_scales

    n = len(points)
    upright = points.new_zeros((n, 4))
    upright[:, 0] = 1.0
    return {
        "means": points,
        "scales": nearest_log_scales(points).to(points),
        "quats": upright,
        "opacities": torch.logit(points.new_full((n,), opacity)),
        "sh0": sh0.to(points),
        "shN": points.new_zeros((n, *params["shN"].shape[1:])),
    }
