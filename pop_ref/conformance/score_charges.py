"""What rounding costs in the scores of pruning and budgeting methods: sums over pixels of products of charged terms.

The functions that are judged take splats and tile lists; these are the oracle's, rounded to the backend's precision, so
the charges of a whole render bound theirs. A Gaussian is compared where every pixel that it may reach is certain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pop_ref.conformance.adapter import projected
from pop_ref.conformance.cases import rounded
from pop_ref.conformance.charges import Layer, PixelCharges
from pop_ref.conformance.gradient_charges import Bound, exponent_slopes
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.verdicts import charged
from pop_ref.types import Splats


@dataclass(frozen=True)
class Screened:
    """A scene as functions of a view's splats take it.

    Attributes:
        scene: as the backend reads it.
        splats: rounded to the backend's precision.
        lists: ids front to back, tile by tile.
        tile_size: px.
        charges: of the render.
        sure: every pixel that the row may reach is clear of rounding. [N]
        smooth: and so is the ceiling there (D6). [N]
    """

    scene: Scene
    splats: Splats
    lists: list[list[int]]
    tile_size: int
    charges: PixelCharges
    sure: np.ndarray
    smooth: np.ndarray

    @property
    def view(self) -> tuple[Splats, list[list[int]], int, int, int]:
        """Return what stage functions of a view begin with."""
        camera = self.scene.camera
        return self.splats, self.lists, camera.width, camera.height, self.tile_size


def screened(backend: Any, scene: Scene) -> Screened:
    """Project a scene for a backend; scenes that its precision cannot resolve are set aside."""
    seen, charges = charged(backend, scene)
    splats, lists = projected(seen)
    columns = ("means2d", "depths", "conics", "opacities", "colors")
    near = rounded(tuple(getattr(splats, name) for name in columns), backend.dtype)
    size = seen.profile.tile_size if seen.tile_size is None else seen.tile_size
    sure, smooth = (_clear_rows(charges, where) for where in (charges.certain, charges.smooth))
    splats = replace(splats, **dict(zip(columns, near, strict=True)))
    return Screened(seen, splats, lists, size, charges, sure, smooth)


def _clear_rows(charges: PixelCharges, certain: np.ndarray) -> np.ndarray:
    clear = np.ones(len(charges.scene.gaussians), dtype=bool)
    floor = charges.scene.profile.alpha_floor * (1.0 - 1e-3)
    for layer in charges.layers:
        clear[layer.id] = bool(np.all(certain[layer.raw >= floor]))
    return clear


def weight_charges(charges: PixelCharges) -> tuple[np.ndarray, np.ndarray]:
    """Charge sums of weights, and of distances, over the pixels of each Gaussian. [N], [N]"""
    n = len(charges.scene.gaussians)
    weights, distances = np.zeros(n), np.zeros(n)
    for layer in charges.layers:
        weights[layer.id] = np.sum(_weight(layer).charge)
        away = np.hypot(layer.dx, layer.dy) + layer.e_dx + layer.e_dy
        distances[layer.id] = np.sum(away * layer.blended)
    return weights, distances


def sensitivity_charges(charges: PixelCharges) -> np.ndarray:
    """Charge Speedy-Splat's score: twice a term times its charge, over pixels. [N]"""
    s = charges.screen
    found = np.zeros(len(charges.scene.gaussians))
    for layer, channels in _alpha_bounds(charges):
        opacity = float(s.opacities[layer.id])
        term = sum(channels[1:], start=channels[0]).times(opacity, s.e_opacities[layer.id])
        found[layer.id] = np.sum(2.0 * term.m * term.charge)
    return found


def moment_charges(charges: PixelCharges, half_tile: float) -> np.ndarray:
    """Charge the screen moments of Fisher blocks. [N, 31]"""
    s = charges.screen
    found = np.zeros((len(charges.scene.gaussians), 31))
    passes = charges.scene.profile.ceiling_gradient == "pass"
    for layer, channels in _alpha_bounds(charges):
        weight = _weight(layer)
        open_ = 1.0 if passes else np.where(layer.raw > charges.scene.profile.alpha_ceiling, 0.0, 1.0)
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


def _alpha_bounds(charges: PixelCharges) -> list[tuple[Layer, list[Bound]]]:
    """Bound dC_c/dalpha of every layer and channel at each pixel, from back to front."""
    s = charges.screen
    shape = charges.T_final.shape
    behind = [Bound(np.full(shape, abs(b)), np.full(shape, abs(b))) for b in charges.scene.background.tolist()]
    found: list[tuple[Layer, list[Bound]]] = []
    for layer in reversed(charges.layers):
        shown = layer.blended.astype(np.float64)
        channels: list[Bound] = []
        for c in range(len(behind)):
            color, e_color = abs(float(s.colors[layer.id, c])), float(s.e_colors[layer.id, c])
            worth = Bound(np.full(shape, color), np.full(shape, e_color + color))
            channels.append((worth + behind[c]).times(layer.T * shown, layer.T_error * shown))
            mixed = worth.times(layer.alpha, layer.e_alpha) + behind[c].times(1.0 - layer.alpha, layer.e_alpha)
            behind[c] = Bound(
                np.where(layer.blended, mixed.m, behind[c].m), np.where(layer.blended, mixed.e, behind[c].e)
            )
        found.append((layer, channels))
    return found
