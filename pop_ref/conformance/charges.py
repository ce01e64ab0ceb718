"""What rounding costs at the pixels, and which decisions it could turn.

Splats are composited over the whole image at once, front to back, carrying the charges of `screen_charges` into alpha,
transmittance, weight and colour. On the way every decision whose distance from its threshold is within reach of
rounding is noted as a doubt: away from doubts integers must match the oracle exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.screen_charges import TINY, ScreenCharges, screen_charges

# a decision is doubtful when its margin is under this many charges: the charges' constant, with room
REACH = 64.0


@dataclass
class PixelCharges:
    """Charges of one render.

    Attributes:
        screen: the charges of projection.
        order: kept splats front to back.
        image, T_final: charges. [H, W, 3], [H, W]
        absolute: sum of weights times absolute colours, background included. [H, W, 3]
        doubtful: some decision of the forward pass at this pixel is within reach of rounding. [H, W]
        kinked: alpha is within reach of the ceiling, which matters to gradients only (D6). [H, W]
        dominance: the two largest weights are within reach of each other (D8). [H, W]
        doubts: label -> mask, of the decisions in `doubtful`. [H, W]
        reach: eps of the dtype times REACH.
        layers: per blended splat, what gradients need.
    """

    screen: ScreenCharges
    order: list[int]
    image: np.ndarray
    T_final: np.ndarray
    absolute: np.ndarray
    doubtful: np.ndarray
    kinked: np.ndarray
    dominance: np.ndarray
    doubts: dict[str, np.ndarray]
    reach: float
    layers: list[dict[str, Any]] = field(default_factory=list)

    @property
    def certain(self) -> np.ndarray:
        """Return where every decision of the image is beyond doubt. [H, W]"""
        return ~self.doubtful


@dataclass
class _State:
    T: np.ndarray
    e_T: np.ndarray
    image: np.ndarray
    absolute: np.ndarray
    alive: np.ndarray
    best: np.ndarray
    e_best: np.ndarray


def charge(scene: Scene, dtype: Any, tile_lists: list[list[int]] | None = None) -> PixelCharges:
    """Charge a scene in the precision of a dtype.

    Args:
        scene: what is drawn.
        dtype: float32 or float64; decides which decisions are doubtful.
        tile_lists: for profiles whose tile lists are part of the meaning, the oracle's.
    """
    screen = screen_charges(scene)
    H, W = scene.camera.height, scene.camera.width
    reach = REACH * float(np.finfo(dtype).eps)
    none = {label: np.zeros((H, W), dtype=bool) for label in ("D1", "D2", "D4", "D5", "D6", "D7", "D8")}
    state = _State(*(np.ones((H, W)), np.zeros((H, W)), np.zeros((H, W, 3)), np.zeros((H, W, 3))),
                   alive=np.ones((H, W), dtype=bool), best=np.zeros((H, W)), e_best=np.zeros((H, W)))  # fmt: skip
    order = [int(i) for i in np.lexsort((np.arange(len(screen.depths)), screen.depths)) if screen.kept[i]]
    layers = []
    for i in order:
        listed = _listed(i, scene, tile_lists)
        layers.append(_blend(i, scene, screen, state, none, reach, listed))
    _doubt_depths(scene, screen, layers, none, reach)
    background = np.abs(scene.background)
    T_final = state.T
    image = state.image + background * (state.e_T + T_final)[..., None] + state.absolute
    doubtful = none["D1"] | none["D2"] | none["D4"] | none["D5"] | none["D7"]
    absolute = state.absolute + background * T_final[..., None]
    return PixelCharges(
        screen, order, image, state.e_T, absolute, doubtful, none["D6"], none["D8"], none, reach, layers
    )


def _listed(i: int, scene: Scene, tile_lists: list[list[int]] | None) -> np.ndarray:
    H, W = scene.camera.height, scene.camera.width
    if tile_lists is None:
        return np.ones((H, W), dtype=bool)
    size = scene.tile_size or scene.profile.tile_size
    tiles_x = -(-W // size)
    tile = (np.arange(H)[:, None] // size) * tiles_x + np.arange(W)[None, :] // size
    return np.array([i in ids for ids in tile_lists])[tile]


def _blend(
    i: int,
    scene: Scene,
    s: ScreenCharges,
    state: _State,
    doubts: dict[str, np.ndarray],
    reach: float,
    listed: np.ndarray,
) -> dict[str, Any]:
    profile = scene.profile
    H, W = state.T.shape
    dx = s.means2d[i, 0] - (np.arange(W)[None, :] + 0.5) + np.zeros((H, 1))
    dy = s.means2d[i, 1] - (np.arange(H)[:, None] + 0.5) + np.zeros((1, W))
    A, B, C = s.conics[i]
    e_A, e_B, e_C = s.e_conics[i]
    e_dx, e_dy = s.e_means2d[i, 0] + np.abs(dx), s.e_means2d[i, 1] + np.abs(dy)
    sigma = 0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy
    absolute = 0.5 * (abs(A) * dx * dx + abs(C) * dy * dy) + abs(B * dx * dy)
    e_form = 0.5 * (e_A * dx * dx + e_C * dy * dy) + e_B * np.abs(dx * dy) + 3.0 * absolute
    e_sigma = e_form + np.abs(A * dx + B * dy) * e_dx + np.abs(C * dy + B * dx) * e_dy
    # a positive exponent beyond every threshold; bounded so that exp stays a number
    raw = s.opacities[i] * np.exp(-np.clip(sigma, 0.0, 700.0))
    e_raw = raw * (e_sigma + 2.0) + s.e_opacities[i] * np.exp(-np.clip(sigma, 0.0, 700.0))
    alpha, e_alpha = np.minimum(raw, profile.alpha_ceiling), np.where(raw > profile.alpha_ceiling, 1.0, e_raw)
    seen = listed & state.alive
    negative = (sigma < reach * e_form) & (absolute > 0.0)
    near_floor = (np.abs(raw - profile.alpha_floor) <= reach * e_raw) | (negative & (raw >= profile.alpha_floor))
    doubts["D5"] |= seen & near_floor
    doubts["D6"] |= seen & (np.abs(raw - profile.alpha_ceiling) <= reach * e_raw)
    if abs(s.det[i]) <= reach * s.e_det[i]:
        doubts["D2"] |= seen & (raw >= profile.alpha_floor * (1.0 - reach))
    if abs(s.depths[i] - profile.near_plane) <= reach * s.e_depths[i] + reach * profile.near_plane * (
        s.e_depths[i] > 0
    ):
        doubts["D1"] |= seen & (raw >= profile.alpha_floor * (1.0 - reach))
    taken = seen & (raw >= profile.alpha_floor) & (sigma >= 0.0)
    next_T = state.T * (1.0 - alpha)
    e_next = state.e_T * (1.0 - alpha) + state.T * e_alpha + 2.0 * next_T
    stop = profile.transmittance_stop
    doubts["D7"] |= taken & (np.abs(next_T - stop) <= reach * (e_next + stop))
    stops = taken & ((next_T <= stop) if profile.stop_inclusive else (next_T < stop))
    blended = taken & ~stops
    weight, e_weight = state.T * alpha, state.T * e_alpha + state.e_T * alpha + state.T * alpha
    doubts["D8"] |= blended & (np.abs(weight - state.best) <= reach * (e_weight + state.e_best)) & (weight > 0.0)
    wins = blended & (weight > state.best)
    state.best, state.e_best = np.where(wins, weight, state.best), np.where(wins, e_weight, state.e_best)
    color, e_color = np.abs(s.colors[i]), s.e_colors[i]
    share = np.where(blended, weight, 0.0)[..., None]
    # one more unit of everything gathered so far pays for the addition
    state.absolute = state.absolute + share * color
    state.image = state.image + share * e_color + np.where(blended, e_weight, 0.0)[..., None] * color + state.absolute
    layer = {"id": i, "blended": blended, "T": state.T, "e_T": state.e_T, "alpha": alpha, "e_alpha": e_alpha, "dx": dx,
             "dy": dy, "e_dx": e_dx, "e_dy": e_dy, "e_sigma": e_sigma, "clamped": raw > profile.alpha_ceiling, "seen": seen,
             "weight": weight, "raw": raw}  # fmt: skip
    state.T, state.e_T = np.where(blended, next_T, state.T), np.where(blended, e_next, state.e_T)
    state.alive = state.alive & ~stops
    return layer


def _doubt_depths(
    scene: Scene, s: ScreenCharges, layers: list[dict[str, Any]], doubts: dict[str, np.ndarray], reach: float
) -> None:
    floor = scene.profile.alpha_floor * (1.0 - 1e-3)
    for a, front in enumerate(layers):
        for back in layers[a + 1 :]:
            i, j = front["id"], back["id"]
            same_place = bool(np.all(scene.gaussians.means[i] == scene.gaussians.means[j]))
            band = reach * (s.e_depths[i] + s.e_depths[j])
            if not same_place and abs(s.depths[i] - s.depths[j]) <= band and band > 0.0:
                doubts["D4"] |= front["seen"] & (front["raw"] >= floor) & (back["raw"] >= floor)


def relative_condition(charges: PixelCharges) -> float:
    """Return the largest relative charge of a conic: how ill-conditioned the worst kept splat is."""
    s = charges.screen
    size = np.max(np.abs(s.conics), axis=1)
    worst = np.max(s.e_conics, axis=1) / np.maximum(size, TINY)
    return float(np.max(worst[s.kept], initial=0.0))
