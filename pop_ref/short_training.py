"""Whole steps on photographs: a method is trained from given Gaussians, cameras and photographs, step by step.

`training.train_step` is what a step of 3DGS and of POP is; methods that pass over all photographs change the Gaussians
between two steps by `methods`, with renders where a script would say what they show. Taming-3DGS's scores are left to
scripts: no short training of it may grow.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pop_ref import density, fisher, methods, sensitivity, training
from pop_ref.chord import DominantPoints, dominant_points
from pop_ref.contributions import Contributions, contributions
from pop_ref.density import Rows, rows_from_params
from pop_ref.recipes import Recipe
from pop_ref.records import Camera
from pop_ref.scripted import ShortTraining
from pop_ref.settings import LearningRates
from pop_ref.splatting import project
from pop_ref.tiles import tile_lists


class Trained:
    """A short training on its way.

    Attributes:
        driven: the method, with its Gaussians.
        step: number of the next step, from 0.
    """

    def __init__(self, short: ShortTraining) -> None:
        self.short, self.step = short, 0
        shown: Any = _Shown(short, self)
        self.driven: Any = methods.Driven(shown, rows_from_params(dict(short.params)))
        # no update has been made
        self.driven.counters = dict.fromkeys(methods.KEYS, 0.0)
        self.driven.recipe = _with_options(self.driven.recipe, short)
        steps = range(len(short.order) // short.batch)
        grows = [step for step in steps if density.densifies_at(step, self.driven.recipe.density)]
        if short.method == "taming" and grows:
            raise ValueError(
                f"step {grows[0]} is a densification step; Taming-3DGS grows by scores, which a short training does "
                "not take: set refine_start_iter to its last step"
            )

    @property
    def recipe(self) -> Recipe:
        """Return what is minimised."""
        found: Recipe = self.driven.recipe
        return found

    def look(self, view: int) -> training.Look:
        """Render a view and compare it with its photograph; see `training.look`."""
        driven = self.driven
        state = training.Training(driven.rows, driven.window, self.step, driven.waiting)
        return training.look(state, *_seen(self.short, view, self.recipe))

    def move(self, views: Sequence[int], looks: Sequence[training.Look]) -> None:
        """Let Adam move what is due by the mean gradient, and let one view after the other join the window."""
        driven, short, recipe = self.driven, self.short, self.recipe
        state = training.Training(driven.rows, driven.window, self.step, driven.waiting)
        numbers = methods.optimizer.update_numbers(methods.KEYS, self.step, recipe)
        driven.counters |= {name: float(number) for name, number in numbers.items()}
        grads = {name: np.mean([found.grads[name] for found in looks], axis=0) for name in methods.KEYS}
        driven.rows, driven.waiting = training.update(driven.rows, grads, state, short.scene_scale, recipe)
        for view, found in zip(views, looks, strict=True):
            camera, mask = short.cameras[view], short.mask(view)
            seen = (found.v_means2d, found.visible, found.dominant_counts, camera.width, camera.height)
            kept = None if mask is None else int(np.sum(mask))
            if driven.collects(self.step):
                driven.window = density.accumulate(driven.window, *seen, recipe.density, kept)

    def change(self) -> dict[str, int]:
        """Do to the Gaussians what is due after the step, and return what was done by its kind."""
        self.step += 1
        done: dict[str, int] = self.driven.change(self.step - 1)
        return {name: count for name, count in done.items() if count}


def taken_steps(short: ShortTraining, before: Sequence[Mapping[str, Any]] | None = None) -> list[dict[str, Any]]:
    """Take the steps of a short training.

    Source: POP paper, section 3, and the papers and code of the methods (`recipes`, `methods.Extras`).
    Departs: nothing.

    Args:
        short: what is trained, and on what.
        before: of every step "params", "m" and "v" that it begins with; None: those that the last one left.

    Returns:
        Of every step: its "view", a list where there are several, its "loss", which is that of the parameters before
        it, and "params", "m" and "v" after it.

    Raises:
        ValueError: it is of Taming-3DGS and grows.

    Example:
        >>> from pop_ref.conformance.short_training import ShortTraining
        >>> first, second = taken_steps(ShortTraining("gsplat", order=(0, 1)))
        >>> first["view"], second["view"], first["params"]["means"].shape
        (0, 1, (6, 3))
    """
    if short.batch > 1 or short.method in ("pup", "mini-splatting", "speedy-splat"):
        return _taken_by_parts(short, before)
    recipe = Trained(short).recipe
    state, draws = training.start(short.params), short.draws()
    found: list[dict[str, Any]] = []
    for step, view in enumerate(short.order):
        state = state if before is None else replace(state, rows=_rows(before[step]))
        camera, target, scale, _, *more = _seen(short, view, recipe)
        state, loss = training.train_step(state, camera, target, scale, draws.normals, recipe, *more)
        found.append(_record(view, loss, state.rows))
    return found


def _taken_by_parts(short: ShortTraining, before: Sequence[Mapping[str, Any]] | None) -> list[dict[str, Any]]:
    """Take steps of several views, or of a method that passes over all photographs between two steps."""
    trained = Trained(short)
    found: list[dict[str, Any]] = []
    for step in range(len(short.order) // short.batch):
        trained.driven.rows = trained.driven.rows if before is None else _rows(before[step])
        views = short.order[step * short.batch : (step + 1) * short.batch]
        looks = [trained.look(view) for view in views]
        trained.move(views, looks)
        trained.change()
        loss = sum(seen.loss for seen in looks) / len(looks)
        found.append(_record(views[0] if len(views) == 1 else list(views), loss, trained.driven.rows))
    return found


def _rows(record: Mapping[str, Any]) -> Rows:
    return Rows(record["params"], record["m"], record["v"])


def _record(view: int | list[int], loss: float, rows: Rows) -> dict[str, Any]:
    return {"view": view, "loss": loss, "params": dict(rows.params), "m": dict(rows.m), "v": dict(rows.v)}


def _seen(short: ShortTraining, view: int, recipe: Recipe) -> tuple[Any, ...]:
    """Return what `training.look` takes of a view."""
    target, points, mask = short.photo(view) / 255.0, short.points(view), short.mask(view)
    background = np.array(short.background)
    return short.cameras[view], target, short.scene_scale, recipe, points, mask, background, short.antialiased


def _with_options(recipe: Recipe, short: ShortTraining) -> Recipe:
    return replace(recipe, **{name: value for name, value in short.options.items() if name not in ("lr", "max_steps")})


@dataclass(frozen=True)
class _Shown:
    """A short training as `methods` is shown a script: what passes say is rendered of the Gaussians as they are."""

    short: ShortTraining
    trained: Trained
    cameras: int = 1

    def __getattr__(self, name: str) -> Any:
        return getattr(self.short, name)

    @property
    def lr(self) -> LearningRates:
        own = methods.RECIPE_OF[self.short.method].lr
        found: LearningRates = self.short.options.get("lr", own)
        return found

    @property
    def max_steps(self) -> int:
        return int(self.short.options.get("max_steps", methods.RECIPE_OF[self.short.method].max_steps))

    @property
    def n_views(self) -> int:
        return len(self.short.cameras)

    @property
    def width(self) -> int:
        return self.short.cameras[0].width

    @property
    def height(self) -> int:
        return self.short.cameras[0].height

    def sh_degree(self, step: int) -> int:
        recipe, bands = self.trained.recipe, self.short.params["shN"].shape[1] + 1
        degree = round(np.sqrt(bands)) - 1
        return methods.optimizer.sh_degree_at(step, recipe.sh_interval, degree, recipe.updates.sh_start_iter)

    def over(self, index: int, n: int, sh_degree: int = 0, divisor: int = 1) -> _Rendered:
        return _Rendered(self.short, self.trained, index, sh_degree, divisor)


class _Rendered:
    """What `scripted.Pass` says, of a view of the Gaussians as they are, each part when it is asked for."""

    def __init__(self, short: ShortTraining, trained: Trained, index: int, sh_degree: int, divisor: int) -> None:
        own, self._degree, self._profile = short.cameras[index], sh_degree, trained.recipe.profile
        self._gaussians = training.gaussians_from_params(trained.driven.rows.params)
        width, height = -(-own.width // divisor), -(-own.height // divisor)
        K = np.diag([width / own.width, height / own.height, 1.0]) @ own.K
        self._camera, self._mask = Camera(own.viewmat, K, width, height), short.mask(index)
        self._behind, size = np.array(short.background), self._profile.tile_size
        self._splats = project(self._gaussians, self._camera, sh_degree, self._profile, short.antialiased)
        given = (self._splats.means2d, self._splats.radii, self._splats.depths, width, height, size, self._profile)
        self._view = (self._splats, tile_lists(*given), width, height, size)

    @functools.cached_property
    def _points(self) -> DominantPoints:
        lists, size = self._view[1], self._view[-1]
        return dominant_points(self._splats, lists, self._gaussians, self._camera, size, self._profile)

    @property
    def points(self) -> np.ndarray:
        return self._points.points

    @property
    def ids(self) -> np.ndarray:
        return self._points.ids

    @property
    def T_final(self) -> np.ndarray:
        return self._points.T_final

    @property
    def dominant_counts(self) -> np.ndarray:
        ids = self.ids if self._mask is None else self.ids[self._mask]
        return np.bincount(ids[ids >= 0], minlength=len(self._gaussians))

    @property
    def found(self) -> Contributions:
        return contributions(*self._view, profile=self._profile)

    @property
    def sensitivities(self) -> np.ndarray:
        return sensitivity.sensitivities(*self._view, self._behind, self._profile)

    @property
    def blocks(self) -> np.ndarray:
        moments = fisher.screen_moments(*self._view, self._behind, self._profile)
        return fisher.fisher_blocks(self._gaussians, self._camera, moments, self._degree, self._profile)
