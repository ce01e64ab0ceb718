"""What rounding costs at the pixels, and which decisions it could turn.

Splats are composited over the whole image at once, front to back, carrying the error bounds of `screen_error_bounds`
into alpha, transmittance, weight and colour. On the way every decision whose distance from its threshold is within
reach of rounding is noted as near its threshold: elsewhere integers must match the oracle exactly. `pop_ref.margins`
measures the same distances one by one and in its own way; a test holds the two against each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.screen_error_bounds import TINY, ScreenErrorBounds, screen_error_bounds

# a decision is near its threshold when its margin is under this many error bounds: the bounds' constant, with room
REACH = 64.0


@dataclass
class Layer:
    """One splat over the whole image, each entry [H, W] unless it says otherwise.

    Attributes:
        id: the splat. scalar
        dx, dy, e_dx, e_dy: offsets mean - pixel with error bounds, px.
        sigma, e_sigma: the exponent.
        raw, e_raw: opacity times falloff before the ceiling.
        alpha, e_alpha: after it.
        e_expanded: error bound of alpha where the exponent is expanded about a tile's centre: its terms are those of an
            offset half a tile longer, and cancel.
        taken: at or over the floor, so blended unless the pixel has ended.
        near_threshold: whether it is taken is within reach of rounding (D1, D2, D5).
        seen: the pixel had not ended.
        blended: taken, seen, and not the end.
        T, T_error: transmittance before it.
        T_after: transmittance after it.
    """

    id: int
    dx: np.ndarray
    dy: np.ndarray
    e_dx: np.ndarray
    e_dy: np.ndarray
    sigma: np.ndarray
    e_sigma: np.ndarray
    raw: np.ndarray
    e_raw: np.ndarray
    alpha: np.ndarray
    e_alpha: np.ndarray
    e_expanded: np.ndarray
    taken: np.ndarray
    near_threshold: np.ndarray
    seen: np.ndarray = field(default_factory=lambda: np.zeros(0))
    blended: np.ndarray = field(default_factory=lambda: np.zeros(0))
    T: np.ndarray = field(default_factory=lambda: np.zeros(0))
    T_error: np.ndarray = field(default_factory=lambda: np.zeros(0))
    T_after: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass
class PixelErrorBounds:
    """Error bounds of one render, and where its decisions are near their thresholds.

    Attributes:
        scene: what was bounded.
        screen: the error bounds of projection.
        layers: splats front to back.
        reach: eps of the dtype times REACH.
        image, T_final: error bounds. [H, W, D], [H, W]
        dominant_weight: error bound of the dominant weight, exponents expanded about tile centres. [H, W]
        absolute: sum of weights times absolute colours, background included. [H, W, D]
        near_threshold: decision label -> where it is within reach of rounding: D1, D4, D5, D6, D7, D8. [H, W]
    """

    scene: Scene
    screen: ScreenErrorBounds
    layers: list[Layer]
    reach: float
    image: np.ndarray
    T_final: np.ndarray
    dominant_weight: np.ndarray
    absolute: np.ndarray
    near_threshold: dict[str, np.ndarray]

    @property
    def unambiguous(self) -> np.ndarray:
        """Return where every decision behind the image is clear of rounding. [H, W]"""
        return ~(
            self.near_threshold["D1"]
            | self.near_threshold["D4"]
            | self.near_threshold["D5"]
            | self.near_threshold["D7"]
        )

    @property
    def smooth(self) -> np.ndarray:
        """Return where the gradient's decisions are clear too: the ceiling (D6). [H, W]"""
        return self.unambiguous & ~self.near_threshold["D6"]

    @property
    def decided(self) -> np.ndarray:
        """Return where the dominant splat is clear too (D8). [H, W]"""
        return self.unambiguous & ~self.near_threshold["D8"]

    def swappable(self, i: int, j: int) -> bool:
        """Tell whether rounding could exchange two splats in depth (D4)."""
        s, means = self.screen, self.scene.gaussians.means
        band = self.reach * (s.e_depths[i] + s.e_depths[j])
        # equal centres go through equal arithmetic and tie in any precision: index order decides
        same = bool(np.all(means[i] == means[j]))
        return not same and band > 0.0 and abs(s.depths[i] - s.depths[j]) <= band

    def worst_condition(self) -> float:
        """Return the largest relative error bound of a conic; infinite where a determinant may round to either sign."""
        s = self.screen
        listed = s.kept | s.near
        flat = np.abs(s.det) <= self.reach * s.e_det
        relative = np.max(s.e_conics, axis=1, initial=0.0) / np.maximum(
            np.max(np.abs(s.conics), axis=1, initial=0.0), TINY
        )
        return float(np.max(np.where(flat, np.inf, relative)[listed], initial=0.0))


@dataclass
class _State:
    T: np.ndarray
    T_error: np.ndarray
    T_expanded: np.ndarray
    image: np.ndarray
    absolute: np.ndarray
    alive: np.ndarray
    best: np.ndarray
    e_best: np.ndarray
    e_best_expanded: np.ndarray


@dataclass(frozen=True)
class Window:
    """A part of an image, for what is too large to be bounded at once.

    Attributes:
        left, top, right, bottom: px, the last two beyond it.
        screen: error bounds of projection of the whole scene.
        rows: the splats that may be seen in it. [N]
    """

    left: int
    top: int
    right: int
    bottom: int
    screen: ScreenErrorBounds
    rows: np.ndarray


def pixel_error_bounds(
    scene: Scene,
    dtype: Any,
    tile_lists: list[list[int]] | None = None,
    channels: Callable[[ScreenErrorBounds], ScreenErrorBounds] | None = None,
    window: Window | None = None,
) -> PixelErrorBounds:
    """Bound the rounding of a render in the precision of a dtype.

    Args:
        scene: what is drawn.
        dtype: float32 or float64; decides which decisions are near their thresholds.
        tile_lists: for profiles whose tile lists are part of the meaning, the oracle's.
        channels: puts other channels in the place of colours: plain colours, depths.
        window: the part of the image that is bounded, None for all of it; every [H, W] is then the window's.
    """
    reach = REACH * float(np.finfo(dtype).eps)
    if window is None:
        screen = screen_error_bounds(scene, reach)
        screen = screen if channels is None else channels(screen)
        everyone = np.ones(len(screen.depths), dtype=bool)
        window = Window(0, 0, scene.camera.width, scene.camera.height, screen, everyone)
    screen = window.screen
    H, W = window.bottom - window.top, window.right - window.left
    near_threshold = {label: np.zeros((H, W), dtype=bool) for label in ("D1", "D4", "D5", "D6", "D7", "D8")}
    none, D = np.zeros((H, W)), screen.colors.shape[1]
    state = _State(np.ones((H, W)), none, none, np.zeros((H, W, D)), np.zeros((H, W, D)),
                   np.ones((H, W), dtype=bool), none, none, none)  # fmt: skip
    layers = []
    for i in np.lexsort((np.arange(len(screen.depths)), screen.depths)).tolist():
        if window.rows[i] and (screen.kept[i] or screen.near[i]):
            layer = _layer(i, scene, window, reach, _listed(i, scene, tile_lists))
            layer.seen = state.alive
            _blend(layer, scene, screen, state, near_threshold, reach)
            layers.append(layer)
    background = np.abs(scene.background)
    image = state.image + background * (state.T_error + state.T)[..., None] + state.absolute
    absolute = state.absolute + background * state.T[..., None]
    weight = state.e_best_expanded
    error_bounds = PixelErrorBounds(
        scene, screen, layers, reach, image, state.T_error, weight, absolute, near_threshold
    )
    _mark_close_depths(error_bounds)
    return error_bounds


def _listed(i: int, scene: Scene, tile_lists: list[list[int]] | None) -> np.ndarray:
    H, W = scene.camera.height, scene.camera.width
    if tile_lists is None:
        return np.ones((H, W), dtype=bool)
    size = scene.tile_size or scene.profile.tile_size
    tile = (np.arange(H)[:, None] // size) * -(-W // size) + np.arange(W)[None, :] // size
    return np.array([i in ids for ids in tile_lists])[tile]


def _layer(i: int, scene: Scene, window: Window, reach: float, listed: np.ndarray) -> Layer:
    profile, s = scene.profile, window.screen
    xs, ys = np.arange(window.left, window.right) + 0.5, np.arange(window.top, window.bottom) + 0.5
    listed = listed[window.top : window.bottom, window.left : window.right]
    dx = s.means2d[i, 0] - xs[None, :] + np.zeros((len(ys), 1))
    dy = s.means2d[i, 1] - ys[:, None] + np.zeros((1, len(xs)))
    e_dx, e_dy = s.e_means2d[i, 0] + np.abs(dx), s.e_means2d[i, 1] + np.abs(dy)
    A, B, C = s.conics[i]
    e_A, e_B, e_C = s.e_conics[i]
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    absolute = 0.5 * (abs(A) * dx * dx + abs(C) * dy * dy) + abs(B * dx * dy)
    e_form = 0.5 * (e_A * dx * dx + e_C * dy * dy) + e_B * np.abs(dx * dy) + 3.0 * absolute
    e_sigma = e_form + np.abs(A * dx + B * dy) * e_dx + np.abs(C * dy + B * dx) * e_dy
    # far beyond every threshold, but still a number
    falloff = np.exp(-np.clip(sigma, 0.0, 700.0))
    # a pixel whose tile does not list the splat never sees it
    raw = np.where(listed, s.opacities[i] * falloff, 0.0)
    e_raw = raw * (e_sigma + 2.0) + np.where(listed, s.e_opacities[i] * falloff, 0.0)
    taken = (raw >= profile.alpha_floor) & (sigma >= 0.0) & bool(s.kept[i])
    # an exponent can only turn negative where rounding spoils the conic
    negative = (sigma < reach * e_form) & (absolute > 0.0) & (raw >= profile.alpha_floor)
    near_threshold = (np.abs(raw - profile.alpha_floor) <= reach * e_raw) | negative
    if s.near[i]:
        near_threshold |= raw >= profile.alpha_floor * (1.0 - reach)
    alpha = np.minimum(raw, profile.alpha_ceiling)
    e_alpha = np.where(raw > profile.alpha_ceiling, 1.0, e_raw)
    half = 0.5 * (scene.tile_size or profile.tile_size)
    far_x, far_y = np.abs(dx) + half, np.abs(dy) + half
    expanded = 0.5 * (abs(A) * far_x * far_x + abs(C) * far_y * far_y) + abs(B) * far_x * far_y
    e_expanded = np.where(raw > profile.alpha_ceiling, 1.0, e_raw + raw * expanded)
    return Layer(i, dx, dy, e_dx, e_dy, sigma, e_sigma, raw, e_raw, alpha, e_alpha, e_expanded, taken, near_threshold)


def _blend(
    layer: Layer, scene: Scene, s: ScreenErrorBounds, state: _State, near_threshold: dict[str, np.ndarray], reach: float
) -> None:
    profile, seen, alpha, e_alpha = scene.profile, layer.seen, layer.alpha, layer.e_alpha
    near_threshold["D1" if s.near[layer.id] else "D5"] |= seen & layer.near_threshold
    near_threshold["D6"] |= seen & (np.abs(layer.raw - profile.alpha_ceiling) <= reach * layer.e_raw)
    taken = seen & layer.taken
    next_T = state.T * (1.0 - alpha)
    e_next = state.T_error * (1.0 - alpha) + state.T * e_alpha + 2.0 * next_T
    stop = profile.transmittance_stop
    near_threshold["D7"] |= taken & (np.abs(next_T - stop) <= reach * (e_next + abs(stop)))
    stops = taken & ((next_T <= stop) if profile.stop_inclusive else (next_T < stop))
    blended = taken & ~stops
    weight, e_weight = state.T * alpha, state.T * e_alpha + state.T_error * alpha + state.T * alpha
    near_threshold["D8"] |= blended & (np.abs(weight - state.best) <= reach * (e_weight + state.e_best))
    wins = blended & (weight > state.best)
    state.best, state.e_best = np.where(wins, weight, state.best), np.where(wins, e_weight, state.e_best)
    e_expanded = state.T * layer.e_expanded + state.T_expanded * alpha + state.T * alpha
    state.e_best_expanded = np.where(wins, e_expanded, state.e_best_expanded)
    e_next_expanded = state.T_expanded * (1.0 - alpha) + state.T * layer.e_expanded + 2.0 * next_T
    state.T_expanded = np.where(blended, e_next_expanded, state.T_expanded)
    share = np.where(blended, weight, 0.0)[..., None]
    color = np.abs(s.colors[layer.id])
    state.absolute = state.absolute + share * color
    # one more unit of everything gathered so far pays for the addition
    gained = share * s.e_colors[layer.id] + np.where(blended, e_weight, 0.0)[..., None] * color
    state.image = state.image + gained + state.absolute
    layer.blended, layer.T, layer.T_error = blended, state.T, state.T_error
    state.T, state.T_error = np.where(blended, next_T, state.T), np.where(blended, e_next, state.T_error)
    state.alive, layer.T_after = state.alive & ~stops, state.T


def _mark_close_depths(error_bounds: PixelErrorBounds) -> None:
    floor, s = error_bounds.scene.profile.alpha_floor * (1.0 - 1e-3), error_bounds.screen
    largest = float(np.max(s.e_depths, initial=0.0))
    for a, front in enumerate(error_bounds.layers):
        farthest = s.depths[front.id] + error_bounds.reach * (s.e_depths[front.id] + largest)
        for back in error_bounds.layers[a + 1 :]:
            if s.depths[back.id] > farthest:
                break
            if error_bounds.swappable(front.id, back.id):
                error_bounds.near_threshold["D4"] |= front.seen & (front.raw >= floor) & (back.raw >= floor)
