"""What rounding costs in the scores of pruning and budgeting methods: sums over pixels of products of bounded terms.

The functions that are judged take splats and tile lists; these are the oracle's, rounded to the backend's precision, so
the error bounds of a whole render bound theirs. A Gaussian is compared where every pixel that it may reach is
unambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import projected
from pop_ref.conformance.assertions import with_error_bounds
from pop_ref.conformance.cases import rounded
from pop_ref.conformance.error_bounds import Layer, PixelErrorBounds
from pop_ref.conformance.gradient_error_bounds import Bound, exponent_slopes
from pop_ref.conformance.scenes import Scene
from pop_ref.records import Splats


@dataclass(frozen=True)
class Screened:
    """A scene as functions of a view's splats take it.

    Attributes:
        scene: as the backend reads it.
        splats: rounded to the backend's precision.
        lists: ids front to back, tile by tile.
        tile_size: px.
        error_bounds: of the render.
        sure: every pixel that the row may reach is clear of rounding. [N]
        smooth: and so is the ceiling there (D6). [N]
    """

    scene: Scene
    splats: Splats
    lists: list[list[int]]
    tile_size: int
    error_bounds: PixelErrorBounds
    sure: np.ndarray
    smooth: np.ndarray

    @property
    def view(self) -> tuple[Splats, list[list[int]], int, int, int]:
        """Return what stage functions of a view begin with."""
        camera = self.scene.camera
        return self.splats, self.lists, camera.width, camera.height, self.tile_size


def screened(backend: Any, scene: Scene) -> Screened:
    """Project a scene for a backend; scenes that its precision cannot resolve are set aside."""
    seen, error_bounds = with_error_bounds(backend, scene)
    splats, lists = projected(seen)
    columns = ("means2d", "depths", "conics", "opacities", "colors")
    near = rounded(tuple(getattr(splats, name) for name in columns), backend.dtype)
    size = seen.profile.tile_size if seen.tile_size is None else seen.tile_size
    sure, smooth = (_clear_rows(error_bounds, where) for where in (error_bounds.unambiguous, error_bounds.smooth))
    splats = replace(splats, **dict(zip(columns, near, strict=True)))
    return Screened(seen, splats, lists, size, error_bounds, sure, smooth)


def _clear_rows(error_bounds: PixelErrorBounds, unambiguous: np.ndarray) -> np.ndarray:
    clear = np.ones(len(error_bounds.scene.gaussians), dtype=bool)
    floor = error_bounds.scene.profile.alpha_floor * (1.0 - 1e-3)
    for layer in error_bounds.layers:
        clear[layer.id] = bool(np.all(unambiguous[layer.raw >= floor]))
    return clear


def weight_error_bounds(error_bounds: PixelErrorBounds) -> tuple[np.ndarray, np.ndarray]:
    """Bound the rounding of sums of weights, and of distances, over the pixels of each Gaussian. [N], [N]"""
    n = len(error_bounds.scene.gaussians)
    weights, distances = np.zeros(n), np.zeros(n)
    for layer in error_bounds.layers:
        weights[layer.id] = np.sum(_weight(layer).error_bound)
        away = np.hypot(layer.dx, layer.dy) + layer.e_dx + layer.e_dy
        distances[layer.id] = np.sum(away * layer.blended)
    return weights, distances


def sensitivity_error_bounds(error_bounds: PixelErrorBounds) -> np.ndarray:
    """Bound the rounding of Speedy-Splat's score: twice a term times its error bound, over pixels. [N]"""
    s = error_bounds.screen
    found = np.zeros(len(error_bounds.scene.gaussians))
    for layer, channels in _alpha_bounds(error_bounds):
        opacity = float(s.opacities[layer.id])
        term = sum(channels[1:], start=channels[0]).times(opacity, s.e_opacities[layer.id])
        found[layer.id] = np.sum(2.0 * term.m * term.error_bound)
    return found


def moment_error_bounds(error_bounds: PixelErrorBounds, half_tile: float) -> np.ndarray:
    """Bound the rounding of the screen moments of Fisher blocks. [N, 31]"""
    s = error_bounds.screen
    found = np.zeros((len(error_bounds.scene.gaussians), 31))
    passes = error_bounds.scene.profile.ceiling_gradient == "pass"
    for layer, channels in _alpha_bounds(error_bounds):
        weight = _weight(layer)
        open_ = 1.0 if passes else np.where(layer.raw > error_bounds.scene.profile.alpha_ceiling, 0.0, 1.0)
        seconds = np.zeros((5, 5))
        for c, v_alpha in enumerate(channels):
            v_sigma = v_alpha.times(layer.raw * open_, (layer.raw * layer.e_sigma + layer.raw) * open_)
            q = exponent_slopes(layer, s, v_sigma, half_tile)
            seconds += [[np.sum(_product(a, b)) for b in q] for a in q]
            found[layer.id, 15 + 5 * c : 20 + 5 * c] = [np.sum(_product(a, weight)) for a in q]
        found[layer.id, :15] = seconds[np.triu_indices(5)]
        found[layer.id, 30] = np.sum(_product(weight, weight))
    return found


def _weight(layer: Layer) -> Bound:
    T, T_error, alpha, e_alpha = layer.T, layer.T_error, layer.alpha, layer.e_alpha
    return Bound(T * alpha * layer.blended, (T_error * alpha + T * e_alpha) * layer.blended)


def _product(a: Bound, b: Bound) -> np.ndarray:
    return a.m * b.e + a.e * b.m + 2.0 * a.m * b.m


def _alpha_bounds(error_bounds: PixelErrorBounds) -> list[tuple[Layer, list[Bound]]]:
    """Bound dC_c/dalpha of every layer and channel at each pixel, from back to front."""
    s = error_bounds.screen
    shape = error_bounds.T_final.shape
    suffix_color = [
        Bound(np.full(shape, abs(b)), np.full(shape, abs(b))) for b in error_bounds.scene.background.tolist()
    ]
    found: list[tuple[Layer, list[Bound]]] = []
    for layer in reversed(error_bounds.layers):
        shown = layer.blended.astype(np.float64)
        channels: list[Bound] = []
        for c in range(len(suffix_color)):
            color, e_color = abs(float(s.colors[layer.id, c])), float(s.e_colors[layer.id, c])
            color_bound = Bound(np.full(shape, color), np.full(shape, e_color + color))
            channels.append((color_bound + suffix_color[c]).times(layer.T * shown, layer.T_error * shown))
            mixed = color_bound.times(layer.alpha, layer.e_alpha) + suffix_color[c].times(
                1.0 - layer.alpha, layer.e_alpha
            )
            suffix_color[c] = Bound(
                np.where(layer.blended, mixed.m, suffix_color[c].m), np.where(layer.blended, mixed.e, suffix_color[c].e)
            )
        found.append((layer, channels))
    return found
