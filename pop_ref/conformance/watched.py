"""Photographs that a training only watches: with rates of 0 it takes its steps, collects, and moves nothing.

What it has collected after every step can so be compared with the oracle's renders of the same Gaussians.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pop_ref.activations import opacities_from_logits, scales_from_log_scales
from pop_ref.conformance.error_bounds import PixelErrorBounds, pixel_error_bounds
from pop_ref.conformance.gradient_error_bounds import gradient_error_bounds
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.views import SIZE, cameras, clear_of_extents, gaussians
from pop_ref.constants import PAPER
from pop_ref.density import DensityConfig, Statistics, accumulate, zero_statistics
from pop_ref.losses import photometric_pop_vjp
from pop_ref.optimizer import sh_degree_at
from pop_ref.records import Camera, Gaussians
from pop_ref.render import Render, render, render_vjp

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
        g = gaussians(self.seed, degree=2, count=14 if self.masked else 6)
        raw = {
            "means": g.means,
            "scales": np.log(g.scales),
            "quats": g.quats,
            "opacities": np.log(g.opacities / (1.0 - g.opacities)),
            "sh0": g.sh[:, :1],
            "shN": g.sh[:, 1:],
        }
        return {name: array.astype(np.float32).astype(np.float64) for name, array in raw.items()}

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """Return the views' cameras in numbers of single precision."""
        single = [(c.viewmat.astype(np.float32), c.K.astype(np.float32)) for c in cameras(VIEWS)]
        sizes = [_OTHER if self.mixed and view == 1 else SIZE for view in range(VIEWS)]
        return [
            Camera(viewmat.astype(np.float64), K.astype(np.float64), *size)
            for (viewmat, K), size in zip(single, sizes, strict=True)
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
        options: dict[str, Any] = {"sh_degree": scene.sh_degree, "profile": scene.profile}
        options |= {"background": scene.background, "antialiased": scene.antialiased}
        seen = render(scene.gaussians, scene.camera, **options)
        v_image = photometric_pop_vjp(seen.image, watch.photo(view) / 255.0, 1.0, 0.0, "valid", mask)
        pulled = render_vjp(scene.gaussians, scene.camera, v_image, **options)
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
