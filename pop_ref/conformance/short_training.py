"""Trainings on photographs: small scenes, several views, few steps; and the verdict on each step.

Photographs are noise, so that every pixel pulls. Seeds are such that rounding decides no pixel at the start. The steps
of a `Watch` have rates of 0: they collect and move nothing, so that what has been collected after every step can be
compared with the oracle's renders of the same Gaussians.

A method takes the steps of a `ShortTraining`, and before every step the oracle takes the parameters and moments that
were found after the last one. So a training is judged wherever it comes to, though single precision goes its own way at
the first decision that rounding turns. Adam's update is bounded over all moments that the gradient's error allows:
where a gradient is nothing but rounding, a row may move either way, and no other may.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from pop_ref.conformance import tolerances
from pop_ref.conformance.adapter import error_bounds_of
from pop_ref.conformance.assertions import assert_close
from pop_ref.conformance.calls import Call, Frame
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene, in_precision
from pop_ref.conformance.signature import Expected
from pop_ref.conformance.strategy_script import Draws
from pop_ref.conformance.views import SIZE as WATCHED
from pop_ref.conformance.views import cameras, clear_of_extents, gaussians, raw_params
from pop_ref.constants import PAPER
from pop_ref.density import DensityConfig, Rows, Statistics, accumulate, zero_statistics
from pop_ref.losses import photometric_pop_vjp
from pop_ref.methods import KEYS
from pop_ref.optimizer import learning_rates, sh_degree_at
from pop_ref.recipes import Recipe
from pop_ref.records import Camera
from pop_ref.render import Render, render, render_vjp
from pop_ref.settings import BETAS, EPS
from pop_ref.short_training import Trained
from pop_ref.training import Look, gaussians_from_params

SIZE: Final = 13, 11


@dataclass(frozen=True)
class ShortTraining:
    """A method, its settings, and the photographs that it is trained on.

    Attributes:
        method: one of `pop_ref.methods.RECIPE_OF`.
        settings: of its strategy, by name; others are those of its recipe.
        options: of the rest of its recipe, by the names of `Recipe`; others are its own.
        order: the view of every step; a training that draws its order itself takes as many steps.
        seed: of Gaussians and photographs.
        count: of Gaussians.
        views: to train on.
        held_out: further views, which are not trained on.
        scene_scale: world units.
        masked: whether pixels of the views do not count.
        background: colour behind everything.
        antialiased: whether opacities make up for the low-pass.
        batch: views of a step.
        sparse: sparse points, of which every photograph sees its own; 0 for none.
        size: width and height of all views, px.
        degree: the highest of the harmonics.
        centred: whether principal points are the middle of the image, as Inria's code takes them to be.
    """

    method: str = "pop"
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    order: tuple[int, ...] = (0, 1, 0, 1)
    seed: int = 0
    count: int = 6
    views: int = 2
    held_out: int = 0
    scene_scale: float = 1.0
    masked: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    batch: int = 1
    sparse: int = 0
    size: tuple[int, int] = SIZE
    degree: int = 2
    centred: bool = False

    @property
    def steps(self) -> int:
        """Return how many steps are taken."""
        return len(self.order) // self.batch

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        """Return raw parameters in numbers of single precision."""
        return raw_params(gaussians(self.seed, self.degree, self.count, self.size))

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """Return the cameras of the views that are trained on, in numbers of single precision."""
        return self._every_camera[: self.views]

    @functools.cached_property
    def held_out_cameras(self) -> list[Camera]:
        """Return the cameras of the other views."""
        return self._every_camera[self.views :]

    @functools.cached_property
    def _every_camera(self) -> list[Camera]:
        every = cameras(self.views + self.held_out, self.centred, self.size)
        # held-out ones see a corner of what the others see, four times as large
        near = [np.diag([1.0, 1.0, 1.0]) if k < self.views else np.diag([4.0, 4.0, 1.0]) for k in range(len(every))]
        return [
            Camera(in_precision(c.viewmat), in_precision(larger @ c.K), c.width, c.height)
            for c, larger in zip(every, near, strict=True)
        ]

    def photo(self, index: int) -> np.ndarray:
        """Return the photograph of a view, held-out ones counted on. uint8 [H, W, 3]"""
        width, height = self.size
        return self._rng(0, index).integers(0, 256, (height, width, 3), np.uint8)

    def mask(self, index: int) -> np.ndarray | None:
        """Return which pixels of a view count, None for all. [H, W]"""
        width, height = self.size
        return self._rng(1, index).random((height, width)) < 0.75 if self.masked else None

    @functools.cached_property
    def cloud(self) -> np.ndarray:
        """Return all sparse points, world. [P, 3]"""
        return in_precision(self.params["means"][-1] + self._rng(2).normal(0.0, 0.5, (self.sparse, 3)))

    def seen(self, index: int) -> np.ndarray:
        """Return which sparse points a photograph sees: every photograph others. [M]"""
        return np.arange(index % 3, self.sparse, 3)

    def points(self, index: int) -> np.ndarray | None:
        """Return the sparse points that a photograph sees, None where there are none. [M, 3]"""
        return self.cloud[self.seen(index)] if self.sparse else None

    def draws(self) -> Draws:
        """Return the random numbers of the training."""
        return Draws(self._rng(3))

    def _rng(self, *of: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *of])


VIEWS = 3
BACKGROUND = (0.25, 0.5, 0.75)
# width and height of the view that has a size of its own, px
_OTHER = 12, 14


@dataclass(frozen=True)
class Watch:
    """Steps of a training that moves nothing.

    Attributes:
        seed: of Gaussians and photographs.
        order: the view of every step, `batch` of them a step.
        settings: of the strategy, by name.
        batch: views of a step.
        masked: whether views have pixels that do not count, those among them that rounding decides.
        antialiased: whether opacities make up for the low-pass.
        sh_interval: steps between bands.
        mixed: whether the second view has a size of its own.
        regularizers: weights of the settings' own terms of the loss, by name; the oracle's gradients leave them out.
    """

    seed: int
    order: tuple[int, ...]
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    batch: int = 1
    masked: bool = False
    antialiased: bool = False
    sh_interval: int = 2
    mixed: bool = False
    regularizers: Mapping[str, float] = field(default_factory=dict[str, float])

    @property
    def steps(self) -> int:
        """Return how many steps are taken."""
        return len(self.order) // self.batch

    @functools.cached_property
    def params(self) -> dict[str, np.ndarray]:
        """Return raw parameters in numbers of single precision."""
        # of few, rounding decides no pixel of some seeds
        return raw_params(gaussians(self.seed, degree=2, count=14 if self.masked else 6, seen_first=True))

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """Return the views' cameras in numbers of single precision."""
        sizes = [_OTHER if self.mixed and view == 1 else WATCHED for view in range(VIEWS)]
        return [
            Camera(in_precision(c.viewmat), in_precision(c.K), *size)
            for c, size in zip(cameras(VIEWS), sizes, strict=True)
        ]

    def photo(self, view: int) -> np.ndarray:
        """Return a view's photograph. uint8 [H, W, 3]"""
        camera = self.cameras[view]
        return np.random.default_rng([self.seed, view]).integers(0, 256, (camera.height, camera.width, 3), np.uint8)

    def mask(self, view: int) -> np.ndarray | None:
        """Return which pixels of a view count; None for all. [H, W]"""
        return self._masks[view] if self.masked else None

    @functools.cached_property
    def _masks(self) -> list[np.ndarray]:
        found: list[np.ndarray] = []
        for view, camera in enumerate(self.cameras):
            bounds = pixel_error_bounds(self.scene(view, self.steps), np.float32)
            kept = np.random.default_rng([self.seed, view, 1]).random((camera.height, camera.width)) < 0.75
            found.append(kept & bounds.smooth & bounds.decided)
        return found

    def scene(self, view: int, step: int) -> Scene:
        """Return what a step draws of a view."""
        g, degree = gaussians_from_params(self.params), sh_degree_at(step, self.sh_interval, 2)
        return Scene(g, self.cameras[view], BACKGROUND, PAPER, None, degree, self.antialiased)


def clear_watch(first_seed: int, **asks: Any) -> Watch:
    """Return such steps in which rounding decides nothing, in single precision.

    Args:
        first_seed: the first that is tried.
        asks: attributes of `Watch`.
    """
    for seed in range(first_seed, first_seed + 256):
        watch = Watch(seed, **asks)
        if all(_clear(watch, view) for view in range(VIEWS)):
            return watch
    raise AssertionError(f"no scene from seed {first_seed} on is clear of rounding")


def _clear(watch: Watch, view: int) -> bool:
    scene = watch.scene(view, watch.steps)
    bounds = pixel_error_bounds(scene, np.float32)
    decided = watch.masked or bool(np.all(bounds.smooth & bounds.decided))
    # pixels first: they rule out most scenes
    return decided and not np.any(bounds.screen.kinked) and bool(np.all(clear_of_extents(scene, np.float32)))


@dataclass(frozen=True)
class Collected:
    """What the oracle has collected after a step, and the error bound of the sums of gradients.

    Attributes:
        window: gradient sums, visible views, dominated pixels, blur flags.
        extents: the largest extent of each, as a share of the longer side of the image. [N]
        waiting: gradients of the bands beyond the first, summed up. [N, K - 1, 3]
        error_bounds: of gradient sums [N] and of `waiting`, in units of eps.
    """

    window: Statistics
    extents: np.ndarray
    waiting: np.ndarray
    error_bounds: tuple[np.ndarray, np.ndarray]


def collected(watch: Watch, dtype: Any) -> list[Collected]:
    """Return what is collected after every step.

    Args:
        watch: the steps.
        dtype: the precision that is judged.
    """
    config = DensityConfig(**{name: v for name, v in watch.settings.items() if name in _OF_WINDOW})
    n = len(watch.params["means"])
    rest = np.zeros_like(watch.params["shN"])
    state = Collected(zero_statistics(n), np.zeros(n), rest, (np.zeros(n), rest))
    found: list[Collected] = []
    for step in range(watch.steps):
        for view in watch.order[step * watch.batch : (step + 1) * watch.batch]:
            state = _with(state, _Look.at(watch, view, step, dtype), watch, config)
        found.append(state)
    return found


_OF_WINDOW = ("blur_window", "theta_blur", "blur_min_pixels")


@dataclass(frozen=True)
class _Look:
    """One view of one step: its render, gradients by the screen and by the bands, and their error bounds."""

    view: int
    render: Render
    v_means2d: np.ndarray
    v_rest: np.ndarray
    e_means2d: np.ndarray
    e_rest: np.ndarray

    @classmethod
    def at(cls, watch: Watch, view: int, step: int, dtype: Any) -> _Look:
        scene, mask = watch.scene(view, step), watch.mask(view)
        seen = render(scene.gaussians, scene.camera, **scene.options)
        v_image = photometric_pop_vjp(seen.image, watch.photo(view) / 255.0, 1.0, 0.0, "valid", mask)
        pulled = render_vjp(scene.gaussians, scene.camera, v_image, **scene.options)
        bounds = pixel_error_bounds(scene, dtype)
        units = gradient_error_bounds(scene, bounds, np.abs(v_image), np.zeros(v_image.shape[:2]), e_cotangents=(
            _slope(mask, v_image.shape) * _of_image(bounds) + np.abs(v_image), np.zeros(v_image.shape[:2]),
        ))  # fmt: skip
        absolute = bool(watch.settings.get("absgrad", False))
        v_means2d = pulled.means2d_abs if absolute else pulled.means2d
        return cls(view, seen, v_means2d, pulled.sh[:, 1:] / watch.batch, units["means2d"], units["sh"][:, 1:])


def _of_image(bounds: PixelErrorBounds) -> np.ndarray:
    return bounds.image + bounds.absolute


def _slope(mask: np.ndarray | None, shape: tuple[int, ...]) -> float:
    """Return what the cotangent of the mean square changes by with a value of the image."""
    return 2.0 / (3.0 * max(shape[0] * shape[1] if mask is None else int(np.sum(mask)), 1))


def _with(state: Collected, look: _Look, watch: Watch, config: DensityConfig) -> Collected:
    camera, mask, n = watch.cameras[look.view], watch.mask(look.view), len(state.extents)
    ids = look.render.dominant_ids if mask is None else look.render.dominant_ids[mask]
    counts = np.bincount(ids[ids >= 0], minlength=n).astype(np.int64)
    visible = look.render.splats.visible
    kept = None if mask is None else int(np.sum(mask))
    given = (look.v_means2d, visible, counts, camera.width, camera.height, config, kept)
    extents = np.where(visible, np.max(look.render.splats.radii, axis=1), 0) / max(camera.width, camera.height)
    half = 0.5 * np.array([camera.width, camera.height])
    e_sums, e_rest = state.error_bounds
    norms = np.linalg.norm(half * look.e_means2d, axis=1) * visible
    return replace(
        state,
        window=accumulate(state.window, *given),
        extents=np.maximum(state.extents, extents),
        waiting=state.waiting + look.v_rest,
        error_bounds=(e_sums + norms, e_rest + look.e_rest),
    )


# under it moments of single precision may be flushed to zero
_SMALLEST: Final = float(np.finfo(np.float32).tiny)
# world units that no step moves a Gaussian by, and that no two are within
PLACE: Final = 0.01
# of the steps of a short training so many must be clear of rounding
_LEAST_JUDGED: Final = 0.6


def assert_steps(
    backend: Any, short: ShortTraining, found: Sequence[Mapping[str, Any]], least: float = _LEAST_JUDGED
) -> set[str]:
    """Assert that every step that was taken is the oracle's.

    Args:
        backend: that took them.
        short: what was trained.
        found: of every step what `pop_ref.short_training.taken_steps` returns; its "view" is the one that was seen.
        least: the share of the steps that must be clear of rounding; of the others nothing is compared but whose the
            rows are.

    Returns:
        What was done to the Gaussians.
    """
    judge, happened, judged = OracleSteps(short, backend.dtype), set[str](), 0
    for step, record in enumerate(found):
        wanted = judge.step(*np.atleast_1d(record["view"]).tolist())
        happened |= wanted.happened
        if wanted.clear:
            judged += 1
            at = f"step {step} of {short.method}"
            sizes = wanted.loss, wanted.loss_size
            assert_close("steps.loss", record["loss"], *sizes, backend.dtype, True, place=_at(f"{at}: loss"))
            _assert_rows(record, wanted.rows, backend.dtype, at)
        _assert_whose(record["params"]["means"], wanted.rows.params["means"], f"step {step} of {short.method}")
        judge.go_on(Rows(*({key: record[kind][key] for key in KEYS} for kind in ("params", "m", "v"))))
    assert judged >= least * len(found), "rounding decides a pixel of most steps"
    return happened


@dataclass(frozen=True)
class WantedStep:
    """What the oracle makes of a step, and what rounding may do to it.

    Attributes:
        loss, loss_size: and the size of its unit.
        rows: Gaussians and moments after the step; further arrays of their parameters hold, of each entry of "params",
            "m" and "v", the size of a unit ("size m means"), and by how much Adam's update may differ ("spread means").
        rates: learning rates.
        clear: whether rounding decides nothing of the render.
        happened: what was done to the Gaussians.
    """

    loss: float
    loss_size: float
    rows: Rows
    rates: Mapping[str, float]
    clear: bool
    happened: set[str]


class OracleSteps:
    """A short training that the oracle takes step by step, with what rounding may do.

    Args:
        short: what is trained.
        dtype: the precision that is judged.
    """

    def __init__(self, short: ShortTraining, dtype: Any) -> None:
        # frozen, which a protocol of attributes does not allow
        given: Any = short
        self._trained, self._waiting, self._dtype = Trained(given), np.zeros(0), dtype

    @property
    def rows(self) -> Rows:
        """Return the Gaussians and moments before the next step."""
        found: Rows = self._trained.driven.rows
        return found

    @property
    def recipe(self) -> Recipe:
        """Return what is minimised."""
        return self._trained.recipe

    def go_on(self, rows: Rows) -> None:
        """Let the next step begin with these."""
        self._trained.driven.rows = rows

    def step(self, *views: int) -> WantedStep:
        """Take a step with a view, or with several."""
        trained, before, number = self._trained, self.rows, self._trained.step
        looks = [trained.look(view) for view in views]
        bounds = [_Bounds(trained, view, seen, self._dtype) for view, seen in zip(views, looks, strict=True)]
        errors = {key: np.mean([each.gradients[key] for each in bounds], axis=0) for key in KEYS}
        self._wait(errors, number)
        clear = all(each.clear for each in bounds)
        trained.move(views, looks)
        self.go_on(_with_errors(trained, before, errors, self._dtype))
        happened = set(trained.change())
        loss = sum(seen.loss for seen in looks) / len(views)
        size = sum(abs(seen.loss) + each.loss_size for seen, each in zip(looks, bounds, strict=True)) / len(views)
        return WantedStep(loss, size, self.rows, _rates(trained, number), clear, happened)

    def _wait(self, errors: dict[str, np.ndarray], number: int) -> None:
        """Add the error bounds of gradients that wait, where the bands beyond the first move at some steps only."""
        every = self.recipe.updates.sh_rest_every
        if every > 1:
            if len(self._waiting) == len(errors["shN"]):
                errors["shN"] = errors["shN"] + self._waiting
            self._waiting = np.zeros(0) if max(number, 1) % every == 0 else errors["shN"]


def _at(where: str) -> Any:
    return lambda index: f"{where}, {list(index)}"


def _assert_whose(found: np.ndarray, expected: np.ndarray, at: str) -> None:
    assert len(found) == len(expected), f"{at} left {len(found)} Gaussians, expected {len(expected)}"
    others = np.flatnonzero(np.any(~(np.abs(found - expected) <= PLACE), axis=1))
    assert not len(others), f"{at} left another Gaussian at row {others[0]}"


def _assert_rows(record: Mapping[str, Any], wanted: Rows, dtype: Any, at: str) -> None:
    for key in KEYS:
        for kind, name in (("m", f"steps.{key}"), ("v", "steps.squares"), ("params", "steps.params")):
            ends = record[kind][key], getattr(wanted, kind)[key]
            size = wanted.params[f"size {kind} {key}"]
            assert_close(name, *ends, size, dtype, True, place=_at(f"{at}: {kind} of {key}"))


@dataclass
class _Bounds:
    """What rounding may do to a step.

    Attributes:
        trained: before the step.
        view: that is seen.
        seen: what the oracle has seen.
        dtype: the precision that is judged.
    """

    trained: Trained
    view: int
    seen: Look
    dtype: Any

    def __post_init__(self) -> None:
        short, recipe = self.trained.short, self.trained.recipe
        self.gaussians = gaussians_from_params(self.trained.driven.rows.params)
        degree = self.trained.driven.script.sh_degree(self.trained.step)
        camera, behind = short.cameras[self.view], np.array(short.background)
        self.scene = Scene(self.gaussians, camera, behind, recipe.profile, None, degree, short.antialiased)
        self.pixels: PixelErrorBounds = error_bounds_of(self.scene, self.dtype)

    @property
    def clear(self) -> bool:
        """Tell whether rounding decides nothing of the render."""
        recipe, pixels = self.trained.recipe, self.pixels
        dominates = recipe.lambda_pop != 0.0 or recipe.density.blur_start_iter < len(self.trained.short.order)
        decided = bool(np.all(pixels.smooth & (pixels.decided | (not dominates))))
        return decided and not np.any(pixels.screen.kinked) and bool(np.all(clear_of_extents(self.scene, self.dtype)))

    @property
    def loss_size(self) -> float:
        """Return what one unit of the loss is eps times of, besides the loss itself."""
        v_image = np.abs(self.seen.v_image[..., :3])
        return float(np.sum(v_image * (self.pixels.image + self.pixels.absolute)))

    @functools.cached_property
    def gradients(self) -> dict[str, np.ndarray]:
        """Return the error bound of every raw parameter's gradient, in units of eps."""
        units, o = self._of_render(), self.gaussians.opacities
        grads = self.seen.grads
        # 1 - o loses digits where o is near 1
        logits = o * (1.0 - o) * units["opacities"] + np.abs(grads["opacities"]) * (1.0 + 1.0 / (1.0 - o))
        raw = {
            "means": units["means"],
            "scales": units["scales"] * self.gaussians.scales,
            "quats": units["quats"],
            "opacities": logits,
            "sh0": units["sh"][:, :1],
            "shN": units["sh"][:, 1:],
        }
        return {key: raw[key] + np.abs(grads[key]) for key in KEYS}

    def _of_render(self) -> dict[str, np.ndarray]:
        v = np.abs(self.seen.v_image)
        recipe, n = self.trained.recipe, v.shape[0] * v.shape[1]
        goal = recipe.at(self.trained.step, recipe.l2_stop_iter)
        # a cotangent changes with the image: that of the square by its slope, that of SSIM by its window's
        slope = 2.0 / (3.0 * n) * (1.0 + 8.0 * goal.lambda_ssim)
        e_image = np.zeros_like(v)
        e_image[..., :3] = v[..., :3] + slope * (self.pixels.image + self.pixels.absolute)
        none = np.zeros(v.shape[:2])
        if v.shape[2] == 3:
            return gradient_error_bounds(self.scene, self.pixels, v, none, e_cotangents=(e_image, none))
        frame = Frame(self.scene)
        expected = Expected(Call(((frame,),), render_mode="RGB+ED"), frame, self.dtype, 0)
        expected.v_image, expected.v_T_final = v + e_image, none
        bounds = expected.gradients[1]
        return {**bounds, "sh": bounds["colors"]}


def _with_errors(trained: Trained, before: Rows, errors: Mapping[str, np.ndarray], dtype: Any) -> Rows:
    """Return the rows after Adam, with the size of a unit of each entry under more keys, which go with their rows."""
    moved, rates, beta2 = trained.driven.rows, _rates(trained, trained.step), trained.recipe.lr.beta2
    limit = tolerances.agreement("steps.params", dtype)
    more: dict[str, np.ndarray] = {}
    for key in KEYS:
        m, v = moved.m[key], moved.v[key]
        g = np.abs(m - BETAS[0] * before.m[key]) / (1.0 - BETAS[0])
        size_m = (1.0 - BETAS[0]) * errors[key] + np.abs(before.m[key]) + np.abs(m)
        size_v = (1.0 - beta2) * 2.0 * g * errors[key] + v
        allowed = [
            tolerances.agreement(name, dtype) * size
            for name, size in ((f"steps.{key}", size_m), ("steps.squares", size_v))
        ]
        squared = (1.0 - beta2) * (tolerances.agreement(f"steps.{key}", dtype) * errors[key]) ** 2 + _SMALLEST
        number, update = trained.driven.counters[key], np.zeros_like(m)
        spread = np.zeros_like(m)
        if number > 0 and not np.array_equal(m, before.m[key]):
            of = number, rates[key], beta2
            update = _update(m, v, *of)
            ends = [_update(m + i * allowed[0], np.maximum(v + j * (allowed[1] + squared), 0.0), *of)
                    for i in (-1.0, 1.0) for j in (-1.0, 1.0)]  # fmt: skip
            spread = np.max([np.abs(end - update) for end in ends], axis=0)
        size = np.abs(moved.params[key]) + np.abs(update) + spread / limit
        squares = size_v + squared / tolerances.agreement("steps.squares", dtype)
        more |= {f"size params {key}": size, f"size m {key}": size_m, f"size v {key}": squares, f"spread {key}": spread}
    none = {name: np.zeros_like(array) for name, array in more.items()}
    return Rows({**moved.params, **more}, {**moved.m, **none}, {**moved.v, **none})


def _rates(trained: Trained, step: int) -> Mapping[str, float]:
    recipe, scale = trained.recipe, trained.short.scene_scale
    return learning_rates(step, scale, recipe.max_steps, recipe.lr, recipe.updates)


def _update(m: np.ndarray, v: np.ndarray, number: float, rate: float, beta2: float) -> np.ndarray:
    denominator = np.sqrt(v) / np.sqrt(1.0 - beta2**number) + EPS
    return -rate / (1.0 - BETAS[0] ** number) * m / denominator
