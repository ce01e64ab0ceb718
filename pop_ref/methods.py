"""Whole trainings by every method of the paper's tables, given what renders and passes over the views say.

The order of a step is that of a run: the prior on opacities joins the loss, Adam moves whose turn it is, the view joins
the window's statistics, and then the Gaussians change if that is due: densification, what the method does besides, a
reset. What a renderer would say is written down by whoever asks (`Script`), so that nothing is rendered here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np

from pop_ref import density, fisher, losses, mini_splatting, optimizer, polarization, selection, taming, training
from pop_ref.density import Rows, zero_statistics
from pop_ref.recipes import BASELINES, RECIPES
from pop_ref.scripted import Script, ScriptedView
from pop_ref.settings import PopTerm, Recipe, ScreenSizeRules

KEYS: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
# of Adam, before the first step of a script: whoever counts from there, or begins anew, shows it
COUNTER: Final = 7.0
_SH_C0: Final = 0.28209479177387814

RECIPE_OF: Final[Mapping[str, Recipe]] = {
    "pop": RECIPES["POP"],
    "gsplat": RECIPES["gsplat"],
    "3dgs": RECIPES["3DGS"],
    "mini-splatting": BASELINES["Mini-Splatting"],
    "taming": BASELINES["Taming-3DGS"],
    "speedy-splat": BASELINES["Speedy-Splat"],
    "pup": BASELINES["PUP-3DGS"],
}
_MINI_STARTS: Final = RECIPE_OF["mini-splatting"].adam_restarts


@dataclass(frozen=True, kw_only=True)
class Extras:
    """What methods do besides 3DGS's density control; its values are the authors'.

    Speedy-Splat's code prunes 80 % after the steps 6000, 9000, 12000 and 30 % each 3000 steps from 15000 on;
    gaussian-splatting-pup 80 % and 50 % at a quarter of the views' size; mini-splatting sets 3.5 million points anew at
    5000 and 10000, of opacity 0.1, draws half at 15000 and drops 1 % of the importance at 20000; taming-3dgs scores by
    ten views and prunes at all of its 28 densification steps but the last.
    """

    absgrad: bool = False
    soft_prune_iters: tuple[int, ...] = (6_000, 9_000, 12_000)
    soft_prune_share: float = 0.8
    hard_prune_iters: tuple[int, ...] = (15_000, 18_000, 21_000, 24_000, 27_000)
    hard_prune_share: float = 0.3
    prune_shares: tuple[float, ...] = (0.8, 0.5)
    score_divisor: int = 4
    reinit_iters: tuple[int, ...] = _MINI_STARTS[:2]
    reinit_points: int = 3_500_000
    reinit_opacity: float = 0.1
    sample_iter: int = _MINI_STARTS[2]
    sampling_factor: float = 0.5
    prune_iter: int = _MINI_STARTS[3]
    prune_mass: float = 0.01
    importance: str = "indoor"
    max_gaussians: int = 4_500_000
    budget_multiplier: float = 2.0
    final_count: int = 0
    score_views: int = 10
    sampled_prunes: int = 27
    misaligned_prune_weights: bool = True


_EXTRAS_OF: Final = {
    "speedy-splat": ("soft_prune_iters", "soft_prune_share", "hard_prune_iters", "hard_prune_share"),
    "pup": ("prune_shares", "score_divisor"),
    "mini-splatting": (
        *("reinit_iters", "reinit_points", "reinit_opacity", "sample_iter", "sampling_factor"),
        *("prune_iter", "prune_mass", "importance", "max_gaussians"),
    ),
    "taming": ("budget_multiplier", "final_count", "score_views", "sampled_prunes", "misaligned_prune_weights"),
}


def _taken(start: Any, settings: Mapping[str, Any]) -> Any:
    return replace(start, **{f.name: settings[f.name] for f in fields(start) if f.name in settings})


def _recipe_of(script: Script, extras: Extras) -> Recipe:
    """Return the script's method under its settings."""
    base, settings = RECIPE_OF[script.method], script.settings
    updates = _taken(base.updates, settings)
    restarts = base.adam_restarts
    if script.method == "pup":
        rounds = range(len(extras.prune_shares) if updates.rounds_start_iter > 0 else 0)
        restarts = tuple(updates.rounds_start_iter + k * updates.round_steps for k in rounds)
    if script.method == "mini-splatting":
        restarts = (*extras.reinit_iters, extras.sample_iter, extras.prune_iter)
    return replace(
        base,
        **{f.name: settings.get(f.name, getattr(base, f.name)) for f in fields(PopTerm)},
        density=_taken(base.density, settings),
        updates=updates,
        lr=script.lr,
        max_steps=script.max_steps,
        adam_restarts=restarts,
    )


def scripted_steps(script: Script, rows: Rows) -> list[dict[str, Any]]:
    """Take a method through a script.

    Source: POP paper, section 3, and the papers and code of the methods (`recipes`, `Extras`).
    Departs: nothing.

    Args:
        script: the method, and what it is shown.
        rows: the Gaussians to start from.

    Returns:
        Of every step: "params", "m", "v" after it, the "counters" of updates by parameter, the "term" on opacities,
        and what was "done" to the Gaussians: how many were cloned, split, pruned, replaced, whether all were reset.

    Example:
        >>> from pop_ref.conformance.strategy_script import Script
        >>> script = Script("gsplat", {"reset_every": 2, "reset_opa": 0.25}, steps=(1, 2))
        >>> [step["done"] for step in scripted_steps(script, script.rows())]
        [{}, {'reset': 1}]
    """
    return Driven(script, rows).steps()


def method_settings(method: str) -> dict[str, Any]:
    """List every setting of a method's strategy by name.

    Source: the methods' papers and code (`recipes`, `Extras`).
    Departs: nothing.

    Args:
        method: one of RECIPE_OF.

    Returns:
        The values that the method is published with.

    Example:
        >>> method_settings("pop")["lambda_pop"], method_settings("pup")["prune_shares"]
        (0.001, (0.8, 0.5))
    """
    recipe = RECIPE_OF[method]
    # only what the method does itself is a setting of its strategy
    kept = {name: value for name, value in vars(Extras()).items() if name in _EXTRAS_OF.get(method, ())}
    prior = {f.name: getattr(recipe, f.name) for f in fields(PopTerm)}
    return {
        **kept,
        **vars(recipe.density),
        **vars(recipe.updates),
        **prior,
        **vars(ScreenSizeRules()),
        "absgrad": False,
    }


class Driven:
    """A method on its way through a script.

    Attributes:
        rows: the Gaussians.
        recipe: what is minimised.
        window, waiting, counters: see `training.Training`, and how many updates each parameter has had.
    """

    def __init__(self, script: Script, rows: Rows) -> None:
        self.script, self.rows = script, rows
        self.extras = _taken(Extras(), script.settings)
        self.recipe = _recipe_of(script, self.extras)
        self.screen = _taken(ScreenSizeRules(), script.settings)
        self.window, self.extents = zero_statistics(len(rows)), np.zeros(len(rows))
        self.first_count = len(rows)
        self.waiting: dict[str, np.ndarray] = {}
        self.counters = dict.fromkeys(KEYS, COUNTER)
        self.draws = script.draws()

    @property
    def n(self) -> int:
        return len(self.rows)

    def steps(self) -> list[dict[str, Any]]:
        """Take every step of the script; see `scripted_steps`."""
        found: list[dict[str, Any]] = []
        for step in self.script.steps:
            view = self.script.view(step, self.n)
            term = self._update(step, view)
            self._collect(step, view)
            done = self.change(step)
            found.append(
                {
                    "params": dict(self.rows.params),
                    "m": dict(self.rows.m),
                    "v": dict(self.rows.v),
                    "counters": dict(self.counters),
                    "term": term,
                    "done": {name: count for name, count in done.items() if count},
                }
            )
        return found

    def _update(self, step: int, view: ScriptedView) -> float:
        script, recipe = self.script, self.recipe
        grads = script.gradients(step, {name: array.shape for name, array in self.rows.params.items()})
        term, pulled = self._term(step, view)
        grads["opacities"] = grads["opacities"] + pulled
        state = training.Training(self.rows, self.window, step, self.waiting)
        self.counters |= {name: float(number) for name, number in optimizer.update_numbers(KEYS, step, recipe).items()}
        self.rows, self.waiting = training.update(self.rows, grads, state, script.scene_scale, recipe)
        return term

    def _term(self, step: int, view: ScriptedView) -> tuple[float, np.ndarray]:
        recipe, of = self.recipe, polarization
        logits, none = self.rows.params["opacities"], np.zeros(self.n)
        if not recipe.pop_start_iter <= step < recipe.pop_stop_iter:
            return 0.0, none
        o = 1.0 / (1.0 + np.exp(-logits))
        counts = view.dominant_counts.sum(0)
        mask = of.importance_mask(counts + self.window.dominant_sum if recipe.pop_views == "window" else counts)
        visible = view.visible.any(0) if recipe.pop_over == "visible" else None
        prior, entropy = recipe.lambda_pop, recipe.lambda_entropy
        term = prior * of.pop_loss(o, mask, visible) + entropy * of.opacity_entropy(logits)
        pulled = of.pop_loss_vjp(o, mask, prior, visible) * o * (1.0 - o)
        return term, pulled + of.opacity_entropy_vjp(logits, entropy)

    def collects(self, step: int) -> bool:
        """Tell whether what a step shows is read later: until nothing grows any more, or the prior reads no window."""
        recipe = self.recipe
        by_prior = recipe.pop_views == "window" and step < recipe.pop_stop_iter
        return by_prior or step < recipe.density.refine_stop_iter

    def _collect(self, step: int, view: ScriptedView) -> None:
        script, config = self.script, self.recipe.density
        if not self.collects(step):
            return
        grads = script.cameras * (view.absolute if self.extras.absgrad else view.v_means2d)
        if config.blur_window == "own_view":
            # of the cameras of one step any may show that a Gaussian is blurred; those of steps before count no more
            config = replace(config, blur_window="any_view")
            self.window = replace(self.window, blurred=np.zeros(self.n, dtype=bool))
        for c in range(script.cameras):
            seen = (grads[c], view.visible[c], view.dominant_counts[c], script.width, script.height)
            self.window = density.accumulate(self.window, *seen, config, view.kept_pixels)
        extents = np.where(view.visible, np.max(view.radii, axis=2), 0) / max(script.width, script.height)
        self.extents = np.maximum(self.extents, np.max(extents, axis=0, initial=0.0))

    def change(self, step: int) -> dict[str, int]:
        """Do what is due after a step, and return what was done by its kind."""
        done, config = self._edited(step), self.recipe.density
        if step == config.final_prune_iter:
            done = self._prune(1.0 / (1.0 + np.exp(-self.rows.params["opacities"])) < config.final_prune_opa, done)
        return done

    def _edited(self, step: int) -> dict[str, int]:
        method = self.script.method
        if step in self.recipe.adam_restarts:
            return self._round(step) if method == "pup" else self._mini_splatting(step)
        full = method == "mini-splatting" and self.n >= self.extras.max_gaussians
        done: dict[str, int] = {}
        if density.densifies_at(step, self.recipe.density) and not full:
            done = self._refine(step)
        if method == "speedy-splat":
            return self._reset(step, self._prune_by_sensitivity(step, done))
        return self._reset(step, done)

    def _reset(self, step: int, done: dict[str, int]) -> dict[str, int]:
        if not density.resets_at(step, self.recipe.density):
            return done
        self.rows = density.reset_opacities(self.rows, self.recipe.density.reset_opa)
        return {**done, "reset": 1}

    def _prune(self, gone: np.ndarray, done: dict[str, int]) -> dict[str, int]:
        self.rows = density.prune_rows(self.rows, gone)
        kept = {f.name: getattr(self.window, f.name)[~gone] for f in fields(self.window) if f.name != "n_views"}
        self.window, self.extents = replace(self.window, **kept), self.extents[~gone]
        self.waiting = {name: array[~gone] for name, array in self.waiting.items()}
        return {**done, "pruned": done.get("pruned", 0) + int(np.sum(gone))}

    def _refine(self, step: int) -> dict[str, int]:
        """Clone, split, prune, forget: what is drawn, for Taming-3DGS."""
        config, scale = self.recipe.density, self.script.scene_scale
        scales = np.exp(self.rows.params["scales"])
        clone, split = density.grow_masks(self.window, scales, scale, step, config)
        if step < self.screen.refine_scale2d_stop_iter:
            split = split | (self.extents > self.screen.grow_scale2d)
        weights, nth = np.zeros(0), 0
        if self.script.method == "taming":
            clone, split, weights, nth = self._drawn_to_grow(step, clone, split)
        rows = density.clone_rows(self.rows, clone)
        padded = np.concatenate([split, np.zeros(int(np.sum(clone)), dtype=bool)])
        n_split = int(np.sum(split))
        normals = self.draws.normals(n_split) if n_split else np.zeros((2, 0, 3))
        rows = density.split_rows(rows, padded, normals, config.revised_opacity)
        extents = np.concatenate([self.extents, self.extents[clone]])
        extents = np.concatenate([extents[~padded], extents[padded], extents[padded]])
        o = 1.0 / (1.0 + np.exp(-rows.params["opacities"]))
        gone = density.prune_mask(o, np.exp(rows.params["scales"]), scale, step, config)
        if config.prune_too_big_after < step < self.screen.refine_scale2d_stop_iter:
            gone = gone | (extents > self.screen.prune_scale2d)
        if self.script.method == "taming":
            gone = self._drawn_to_go(gone, weights, nth)
        self.rows = density.prune_rows(rows, gone)
        self.window, self.extents = zero_statistics(self.n), np.zeros(self.n)
        self.waiting = {}
        return {"cloned": int(np.sum(clone)), "split": n_split, "pruned": int(np.sum(gone))}

    def _drawn_to_grow(
        self, step: int, clone: np.ndarray, split: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
        config, extras, script = self.recipe.density, self.extras, self.script
        order = np.argsort(self.draws.uniforms(script.n_views))[: extras.score_views]
        grads = density.average_grads(self.window, config)
        params, scores = self.rows.params, np.zeros(self.n)
        for index in order:
            view = script.over(int(index), self.n, script.sh_degree(step))
            photo, mask = script.photo(int(index)), script.mask(int(index))
            mean = np.mean(taming.pixel_weights(view.image, photo, mask))
            found = replace(view.found, map_sum=view.found.map_sum * mean)
            photometric = losses.photometric_3dgs(view.image, photo / 255.0, padding="same", mask=mask)
            o, scales = 1.0 / (1.0 + np.exp(-params["opacities"])), np.exp(params["scales"])
            scores += taming.view_score(photometric, grads, o, scales, view.depths, view.radii, found)
        before = config.refine_start_iter // config.refine_every
        n, nth = (at // config.refine_every - before for at in (config.refine_stop_iter, step))
        target = extras.final_count or int(extras.budget_multiplier * self.first_count)
        budget = taming.budget_at(nth, n, self.first_count, target)
        quotas = taming.quotas(budget, self.n, int(np.sum(clone)), int(np.sum(split)))
        clone, split = (self._sampled(np.where(m, scores, 0.0), q) for m, q in zip((clone, split), quotas, strict=True))
        inverse = 1.0 / (1e-6 + scores)
        return clone, split, inverse if extras.misaligned_prune_weights else inverse[~split], nth

    def _drawn_to_go(self, gone: np.ndarray, weights: np.ndarray, nth: int) -> np.ndarray:
        if nth > self.extras.sampled_prunes:
            return np.zeros_like(gone)
        of_all = np.zeros(len(gone))
        of_all[: len(weights)] = weights[: len(gone)]
        return gone & self._sampled(of_all, int(np.sum(gone)) // 2)

    def _sampled(self, weights: np.ndarray, wanted: int) -> np.ndarray:
        wanted = min(wanted, int(np.sum(weights > 0.0)))
        mask = np.zeros(len(weights), dtype=bool)
        mask[selection.sample_without_replacement(weights, wanted, self.draws.uniforms(len(weights)))] = True
        return mask

    def _prune_by_sensitivity(self, step: int, done: dict[str, int]) -> dict[str, int]:
        extras, script = self.extras, self.script
        share = extras.soft_prune_share if step in extras.soft_prune_iters else 0.0
        share = extras.hard_prune_share if step in extras.hard_prune_iters else share
        if share == 0.0:
            return done
        degree = script.sh_degree(step)
        scores = np.sum([script.over(k, self.n, degree).sensitivities for k in range(script.n_views)], axis=0)
        return self._prune(selection.lowest_share(scores, share), done)

    def _forget_moments(self) -> None:
        zeros = [{name: np.zeros_like(a) for name, a in self.rows.params.items()} for _ in range(2)]
        self.rows, self.counters = replace(self.rows, m=zeros[0], v=zeros[1]), dict.fromkeys(KEYS, 0.0)

    def _round(self, step: int) -> dict[str, int]:
        script, extras = self.script, self.extras
        asked = (self.n, script.sh_degree(step), extras.score_divisor)
        scores = fisher.log_det_scores(np.sum([script.over(k, *asked).blocks for k in range(script.n_views)], 0))
        share = extras.prune_shares[self.recipe.adam_restarts.index(step)]
        done = self._prune(selection.lowest_share(scores, share), {})
        self._forget_moments()
        return done

    def _mini_splatting(self, step: int) -> dict[str, int]:
        extras, script = self.extras, self.script
        if step in extras.reinit_iters:
            return self._set_anew(step)
        views = [script.over(k, self.n, script.sh_degree(step)) for k in range(script.n_views)]
        seen = [(view.found, view.dominant_counts) for view in views]
        importance = mini_splatting.scene_importance(seen, extras.importance == "outdoor")
        if step == extras.prune_iter:
            done = self._prune(selection.least_mass(importance, extras.prune_mass), {})
            self._forget_moments()
            return done
        wanted = int(extras.sampling_factor * int(np.sum(importance > 0.0)))
        drawn = selection.sample_without_replacement(importance, wanted, self.draws.uniforms(self.n))
        return self._begin_anew(self.rows.params["means"][drawn], self.rows.params["sh0"][drawn])

    def _set_anew(self, step: int) -> dict[str, int]:
        script = self.script
        points: list[np.ndarray] = []
        colors: list[np.ndarray] = []
        wanted = mini_splatting.samples_per_view(script.n_views, script.width, script.height, self.extras.reinit_points)
        for index in range(script.n_views):
            view = script.over(index, self.n, script.sh_degree(step))
            mask = script.mask(index)
            shown = (view.ids >= 0) & (True if mask is None else mask)
            weights = np.where(shown, 1.0 - view.T_final, 0.0).ravel()
            count = min(wanted, int(np.sum(weights > 0.0)))
            drawn = selection.sample_without_replacement(weights, count, self.draws.uniforms(len(weights)))
            points.append(view.points.reshape(-1, 3)[drawn])
            colors.append(script.photo(index).reshape(-1, 3)[drawn] / 255.0)
        return self._begin_anew(np.concatenate(points), ((np.concatenate(colors) - 0.5) / _SH_C0)[:, None])

    def _begin_anew(self, points: np.ndarray, sh0: np.ndarray) -> dict[str, int]:
        n, o = len(points), self.extras.reinit_opacity
        params = {
            "means": points,
            "scales": mini_splatting.nearest_log_scales(points),
            "quats": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            "opacities": np.full(n, np.log(o / (1.0 - o))),
            "sh0": sh0,
            "shN": np.zeros((n, *self.rows.params["shN"].shape[1:])),
        }
        self.rows = density.rows_from_params(params)
        self.window, self.extents, self.waiting = zero_statistics(n), np.zeros(n), {}
        self.counters = dict.fromkeys(KEYS, 0.0)
        return {"replaced": n}
