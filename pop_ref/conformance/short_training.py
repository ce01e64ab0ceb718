"""Trainings on photographs: small scenes, several views, and few steps.

Photographs are noise, so that every pixel pulls. Seeds are such that rounding decides no pixel at the start. A method
takes the steps of a `ShortTraining`. The steps of a `Watch` have rates of 0: they collect and move nothing, so that
what has been collected after every step can be compared with the oracle's renders of the same Gaussians.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np

from pop_ref.activations import opacities_from_logits, scales_from_log_scales
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene, in_precision
from pop_ref.conformance.strategy_script import Draws
from pop_ref.conformance.views import SIZE as WATCHED
from pop_ref.conformance.views import cameras, clear_of_extents, gaussians, raw_params
from pop_ref.constants import PAPER
from pop_ref.density import Statistics, accumulate, zero_statistics
from pop_ref.density_config import DensityConfig
from pop_ref.losses import photometric_pop_vjp
from pop_ref.optimizer import sh_degree_at
from pop_ref.records import Camera, Gaussians
from pop_ref.render import Render, render, render_vjp

DEGREE: Final = 2
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
    centred: bool = False

    @property
    def steps(self) -> int:
        """Return how many steps are taken."""
        return len(self.order) // self.batch

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        """Return raw parameters in numbers of single precision."""
        return raw_params(gaussians(self.seed, DEGREE, self.count, self.size))

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
        return raw_params(gaussians(self.seed, degree=2, count=14 if self.masked else 6))

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
        p = self.params
        sh = np.concatenate((p["sh0"], p["shN"]), axis=1)
        scales, opacities = scales_from_log_scales(p["scales"]), opacities_from_logits(p["opacities"])
        g = Gaussians(p["means"], p["quats"], scales, opacities, sh)
        degree = sh_degree_at(step, self.sh_interval, 2)
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
    if not np.all(clear_of_extents(scene, np.float32)):
        return False
    bounds = pixel_error_bounds(scene, np.float32)
    decided = watch.masked or bool(np.all(bounds.smooth & bounds.decided))
    return decided and not np.any(bounds.screen.kinked)


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
