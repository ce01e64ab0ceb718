"""The methods of density control: POP, gsplat's default strategy, Inria's 3DGS, and the methods built on that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Final, Literal, Self

from pop_fast.density.control import DensityControl
from pop_fast.density.protocol import DensificationContext, DensificationStep, Params
from pop_ref.recipes import BASELINES, RECIPES, Recipe

if TYPE_CHECKING:
    from torch import Tensor

_GSPLAT: Final[Recipe] = RECIPES["gsplat"]


@dataclass(frozen=True, kw_only=True)
class GsplatStrategy(DensityControl):
    """Growth by gradient alone, and opacity reset at steps 3000, 6000, 9000 and 12000.

    The defaults are those of gsplat's main since August 2025: 1.1 to 1.5.2 reset at step 0 as well (`reset_at_zero`),
    and 1.5.3 never, by a slip of operator precedence.
    """

    reset_every: int = _GSPLAT.density.reset_every
    prune_too_big: bool = _GSPLAT.density.prune_too_big
    blur_stop_iter: int = _GSPLAT.density.blur_stop_iter
    lambda_pop: float = _GSPLAT.lambda_pop


@dataclass(frozen=True, kw_only=True)
class InriaStrategy(GsplatStrategy):
    """The same rules as in Inria's code: a gradient exactly at the threshold grows, and a step that edits the Gaussians
    has no update."""

    inclusive: bool = RECIPES["3DGS"].density.inclusive
    edits_replace_update: bool = RECIPES["3DGS"].updates.edits_replace_update


@dataclass(frozen=True, kw_only=True)
class Inria2023Strategy(InriaStrategy):
    """Inria's code before October 2024. Its opacities had twice the rate, which is a learning rate and not set here."""


@dataclass(frozen=True, kw_only=True)
class POPStrategy(DensityControl):
    """Density control of the POP paper, with the reading of every open question as a setting.

    A Gaussian grows when its screen gradient is large (as in gsplat) or, from `blur_start_iter` to `blur_stop_iter`,
    when it is the dominant Gaussian of more than `theta_blur * H * W` pixels of a view. Opacities are never reset.
    Instead `regularizer` adds `lambda_pop * L_pop` to the loss, which pushes the opacities of Gaussians that dominate a
    pixel to 1 and the others to 0. Another trainer adds this term itself if `regularizer` returns one:

        state = strategy.initialize_state(scene_scale)
        for step, (viewmat, K, photograph) in enumerate(views):
            opacities = torch.sigmoid(params["opacities"])
            image, _, info = rasterization(
                params["means"], params["quats"], params["scales"].exp(), opacities,
                torch.cat((params["sh0"], params["shN"]), dim=1), viewmat[None], K[None], width, height,
                sh_degree=3, packed=False,
            )
            strategy.step_pre_backward(params, optimizers, state, step, info)
            loss = (image[0] - photograph).abs().mean()
            prior = strategy.regularizer(opacities, state, step, info)
            if prior is not None:
                loss = loss + prior
            loss.backward()
            for optimizer in optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            strategy.step_post_backward(params, optimizers, state, step, info, packed=False)

    The defaults are those of `pop_ref.settings`; with `reset_every=3000, prune_too_big=True, lambda_pop=0.0` it is the
    paper's row "Reset".
    """


_MINI: Final[Recipe] = BASELINES["Mini-Splatting"]


@dataclass(frozen=True, kw_only=True)
class MiniSplattingStrategy(InriaStrategy):
    """Mini-Splatting: blur split, points set anew from depth, then importance-weighted sampling and pruning.

    Source: Fang and Wang 2024 and its code. 3DGS grows by gradient here too; what dominates more than HW / 5000 pixels
    of any view since the last densification step is split whatever its size. At steps 5,000 and 10,000 all Gaussians
    are replaced by points on the rays of pixels drawn from every training view, where the Gaussian that the pixel
    belongs to is densest (`pop_ref.chord`). At 15,000 half of them, drawn by importance, keep place and colour and
    begin anew; at 20,000 the least important go that make up 1 % of all importance. Opacities are never reset, colours
    have one band until 15,000, and the positions' rate goes back at 15,000 to what it was at 5,000. Everything else is
    3DGS of 2023. The paper's Mini-Splatting* samples a share of 0.4 on Tanks & Temples.

    Attributes:
        reinit_iters: steps after which all Gaussians are replaced by points of the training views' depth.
        reinit_points: how many points at most, divided evenly among the views.
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

    def at_rest(self) -> Self:
        """Return the same settings without changes of the Gaussians."""
        return replace(super().at_rest(), reinit_iters=(), sample_iter=-1, prune_iter=-1)

    def is_refine_step(self, step: int) -> bool:
        """Tell whether Gaussians are cloned and split after this step: not where they are replaced."""
        return super().is_refine_step(step) and step not in self.reinit_iters

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Do what is due after this step."""
        if context.step not in self.adam_restarts:
            return super().edit(context)
        if context.step in self.reinit_iters:
            return self._set_anew_from_depth(context)
        is_draw = context.step == self.sample_iter
        return self._draw_by_importance(context) if is_draw else self._prune_by_importance(context)

    def refine(self, context: DensificationContext) -> DensificationStep:
        """Clone, split and prune as 3DGS, unless there are too many Gaussians."""
        return DensificationStep() if len(context) >= self.max_gaussians else super().refine(context)

    def _set_anew_from_depth(self, context: DensificationContext) -> DensificationStep:
        """Replace all Gaussians by points of the training views, with their pixels' colours."""
        import torch

        from pop_fast.io.formats.cloud import SH_C0

        found = [self._points_of_view(context, index) for index in range(context.views.n_views)]
        points, colors = zip(*found, strict=True)
        sh0 = ((torch.cat(colors) - 0.5) / SH_C0)[:, None]
        return self._begin_anew(context, torch.cat(points), sh0)

    def _points_of_view(self, context: DensificationContext, index: int) -> tuple[Tensor, Tensor]:
        """Draw pixels by their opacity, and return their points and their photograph's colours. [M, 3] each"""
        import torch

        from pop_fast.stages.density import sample_without_replacement, samples_per_view

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

        from pop_fast.stages.density import view_importance

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
        from pop_fast.stages.density import sample_without_replacement

        weights = self._importances(context)
        wanted = int(self.sampling_factor * int((weights > 0.0).sum()))
        drawn = sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))
        drawn = drawn.to(context.params["means"].device)
        return self._begin_anew(context, context.params["means"].detach()[drawn], context.params["sh0"].detach()[drawn])

    def _prune_by_importance(self, context: DensificationContext) -> DensificationStep:
        """Remove the least important Gaussians, and start Adam anew."""
        from pop_fast.density.rows import prune_marked, restart
        from pop_fast.stages.density import least_mass

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

    from pop_fast.stages.density import nearest_log_scales

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


_PUP: Final[Recipe] = BASELINES["PUP-3DGS"]


@dataclass(frozen=True, kw_only=True)
class PupStrategy(InriaStrategy):
    """PUP-3DGS: two rounds of pruning by sensitivity and refining, after a whole training of 3DGS.

    Source: Hanson et al. 2025 and its code. The score of a Gaussian is the log-determinant of the Fisher block of its
    mean and log-scale, summed over pixels and channels of all training views at a quarter of their size
    (`pop_ref.fisher`). A round removes the lowest scores, starts Adam anew, and trains 5,000 steps without
    densification, with the positions' rate where the training has ended and all others falling by 5 % each 400 steps
    (`pop_ref.optimizer`). The rounds remove 80 % and then 50 %; the paper's PUP* removes 70 % and then 50 %. What comes
    before is 3DGS of 2023.

    Attributes:
        prune_shares: share of the Gaussians that each round removes at its beginning.
        score_divisor: of the training views' width and height, where scores are taken.
    """

    rounds_start_iter: int = _PUP.updates.rounds_start_iter
    prune_shares: tuple[float, ...] = (0.8, 0.5)
    score_divisor: int = 4

    @property
    def adam_restarts(self) -> tuple[int, ...]:
        """Return the first step of every round: it prunes, and moves nothing."""
        rounds = range(len(self.prune_shares) if self.rounds_start_iter > 0 else 0)
        return tuple(self.rounds_start_iter + k * self.round_steps for k in rounds)

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Refine and reset as 3DGS; at the beginning of a round prune and start Adam anew."""
        if context.step not in self.adam_restarts:
            return super().edit(context)
        from pop_fast.density.rows import prune_lowest, restart, summed_over_views
        from pop_fast.stages.contributions import log_det_scores

        views, divisor = context.views, self.score_divisor
        blocks = summed_over_views(
            context, lambda index: views.fisher(context.params, index, context.sh_degree, divisor)
        )
        share = self.prune_shares[self.adam_restarts.index(context.step)]
        pruned = prune_lowest(context, log_det_scores(blocks), share)
        restart(context.params, context.optimizers)
        return DensificationStep(pruned=pruned)


@dataclass(frozen=True, kw_only=True)
class SpeedySplatStrategy(InriaStrategy):
    """Speedy-Splat: 3DGS on exact tile lists, with most Gaussians pruned by their sensitivity during and after growth.

    Source: Hanson et al. 2025 and its code. The renderer is profile "speedy_splat", whose tiles are those that the
    ellipse of alpha >= 1/255 meets (SnugBox, AccuTile). The score of a Gaussian is the square of what its value at a
    pixel means for the pixel's colour, over all pixels of all training views (`pop_ref.sensitivity`). At steps 6000,
    9000 and 12000, after densification and before the opacity reset, the lowest 80 % go; from step 15000 on each 3000
    steps the lowest 30 %, after the update. Everything else is 3DGS of 2023.

    Attributes:
        soft_prune_iters: steps of soft pruning, each after its densification and before its reset.
        soft_prune_share: share of the Gaussians that each removes.
        hard_prune_iters: steps of hard pruning, each after its update.
        hard_prune_share: share of the Gaussians that each removes.
    """

    soft_prune_iters: tuple[int, ...] = (6_000, 9_000, 12_000)
    soft_prune_share: float = 0.8
    hard_prune_iters: tuple[int, ...] = (15_000, 18_000, 21_000, 24_000, 27_000)
    hard_prune_share: float = 0.3
    scaled_steps = (*InriaStrategy.scaled_steps, "soft_prune_iters", "hard_prune_iters")

    def at_rest(self) -> Self:
        """Return the same settings without changes of the Gaussians."""
        return replace(super().at_rest(), soft_prune_iters=(), hard_prune_iters=())

    def prune_share_at(self, step: int) -> float:
        """Return the share of the Gaussians that is removed by sensitivity after this step."""
        soft = self.soft_prune_share if step in self.soft_prune_iters else 0.0
        return self.hard_prune_share if step in self.hard_prune_iters else soft

    def needs_passes(self, step: int) -> bool:
        """Tell whether sensitivities are asked for."""
        return self.prune_share_at(step) > 0.0

    def edit(self, context: DensificationContext) -> DensificationStep:
        """Refine, prune by sensitivity, reset: in this order."""
        done = self.refine(context) if self.is_refine_step(context.step) else DensificationStep()
        share = self.prune_share_at(context.step)
        if share > 0.0:
            from pop_fast.density.rows import prune_lowest, summed_over_views

            views = context.views
            scores = summed_over_views(
                context, lambda index: views.sensitivities(context.params, index, context.sh_degree)
            )
            done = replace(done, pruned=done.pruned + prune_lowest(context, scores, share))
        return self.reset(context, done)


_TAMING: Final[Recipe] = BASELINES["Taming-3DGS"]


@dataclass(frozen=True, kw_only=True)
class TamingStrategy(InriaStrategy):
    """Taming-3DGS: growth to a budget, by sampling from a score of nine terms.

    Source: Mallick et al. 2024 and its code. Every 500 steps the Gaussians may grow in number, along a parabola from
    the first number to the budget (`pop_ref.taming`). Ten training views score each Gaussian by the view's loss times
    nine terms; of those that 3DGS would clone or split, as many as the parabola has room for are drawn by score. Of
    those that 3DGS would prune, only those also drawn go, half as many as there are, by the inverse of the score; the
    last densification step prunes nothing. The draw takes the scores in the order from before the split, where they
    belong to other Gaussians: a slip of the released code, with which the published numbers were made. The bands beyond
    the first move each 16 steps by the sum of their gradients, opacities not at all after step 15,000, where the code
    hands Adam a tensor that it does not train. Everything else is 3DGS of 2024, with twice its rate for these bands. Of
    photographs with masks, which the code does not know, what they leave out is in no view's loss or map of errors.

    Attributes:
        budget_multiplier: the budget, in first Gaussians: 15 outdoors and 2 indoors of Mip-NeRF 360, 2 on Tanks &
            Temples, 5 on Deep Blending. The paper's count on Mip-NeRF 360 is that of 3 everywhere.
        final_count: the budget itself; 0 takes the multiplier.
        score_views: training views that a densification step scores by.
        sampled_prunes: densification steps, from the first, that prune; the last one of all prunes nothing.
        misaligned_prune_weights: prune by the scores in the order from before the split, as the released
            code does, where they belong to other Gaussians; False draws with those of the Gaussians themselves.
    """

    refine_every: int = _TAMING.density.refine_every
    sh_rest_every: int = _TAMING.updates.sh_rest_every
    opacities_stop_iter: int = _TAMING.updates.opacities_stop_iter
    budget_multiplier: float = 2.0
    final_count: int = 0
    score_views: int = 10
    sampled_prunes: int = 27
    misaligned_prune_weights: bool = True

    def needs_passes(self, step: int) -> bool:
        """Tell whether scores are asked for."""
        return self.is_refine_step(step)

    @property
    def n_densifications(self) -> int:
        """Return in how many steps of the parabola the budget is reached."""
        return self.densification_at(self.refine_stop_iter)

    def densification_at(self, step: int) -> int:
        """Return which step of the parabola this is, from 1."""
        return step // self.refine_every - self.refine_start_iter // self.refine_every

    def refine(self, context: DensificationContext) -> DensificationStep:
        """Clone, split and prune the Gaussians that are drawn."""
        import torch

        from pop_fast.stages.density import budget_at, quotas

        scores, nth = self._scores(context), self.densification_at(context.step)
        clones, splits = self.planned_growth(context)
        target = self.target(context.state["first_count"])
        budget = budget_at(nth, self.n_densifications, context.state["first_count"], target)
        n_clone, n_split = quotas(budget, len(context), int(clones.sum()), int(splits.sum()))
        clones, splits = (
            _drawn(torch.where(candidates.cpu(), scores, 0.0), wanted, context)
            for candidates, wanted in ((clones, n_clone), (splits, n_split))
        )
        # after the split its parents' rows are gone
        inverse = 1.0 / (1e-6 + scores)
        weights = inverse if self.misaligned_prune_weights else inverse[~splits.cpu()]

        def planned_prune() -> Tensor:
            mask = self.planned_prune(context)
            return torch.zeros_like(mask) if nth > self.sampled_prunes else mask & _drawn_to_go(mask, weights, context)

        return self.densify(context, clones, splits, planned_prune)

    def _scores(self, context: DensificationContext) -> Tensor:
        """Score the Gaussians by a few training views. [N] float64, on the CPU"""
        import torch

        from pop_fast.density.rows import window
        from pop_fast.stages.density import average_grads, pixel_weights, view_score
        from pop_fast.stages.losses import photometric_3dgs

        views, params = context.views, context.params
        order = torch.argsort(context.draws.uniforms(views.n_views))[: self.score_views].tolist()
        grads = average_grads(window(context.state), self)
        opacities, scales = torch.sigmoid(params["opacities"].flatten()), torch.exp(params["scales"])
        total = torch.zeros(len(context), dtype=torch.float64)
        for index in order:
            photo, mask = views.photo(index), views.view(index).mask
            mask = None if mask is None else mask.to(photo.device)
            found = views.contributions(
                params, index, context.sh_degree, lambda image, shot=(photo, mask): pixel_weights(image, *shot)
            )
            target = photo.to(found.image.dtype) / 255.0
            photometric = photometric_3dgs(found.image, target, padding="same", mask=mask)
            total += view_score(photometric, grads, opacities, scales, found.depths, found.radii, found).cpu()
        return total

    def target(self, first_count: int) -> int:
        """Return the budget."""
        return self.final_count or int(self.budget_multiplier * first_count)


def _drawn(weights: Tensor, wanted: int, context: DensificationContext) -> Tensor:
    """Draw at most so many Gaussians by weight. [N] bool"""
    import torch

    from pop_fast.stages.density import sample_without_replacement

    wanted = min(wanted, int((weights > 0.0).sum()))
    mask = torch.zeros(len(weights), dtype=torch.bool)
    mask[sample_without_replacement(weights, wanted, context.draws.uniforms(len(weights)))] = True
    return mask.to(context.params["means"].device)


def _drawn_to_go(mask: Tensor, weights: Tensor, context: DensificationContext) -> Tensor:
    """Draw half as many as may go, by the weights of the first rows; the others, which are new, stay. [N] bool"""
    of_all = weights.new_zeros(len(mask))
    of_all[: len(weights)] = weights[: len(mask)]
    return _drawn(of_all, int(mask.sum()) // 2, context)
