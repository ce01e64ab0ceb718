"""What rounding costs up to the screen and at the pixels, and which decisions it could turn.

Every quantity x carries an error bound e(x), so that a computation in precision eps may be wrong by about eps * e(x).
Bounds follow the textbook rule on absolute values, `e(f(x)) = |df/dx| e(x) + |terms of f|`, so they grow where terms
cancel (needles, splats seen edge-on) and nowhere else. They are of first order and hold for any order of evaluation.

Splats are then composited over the whole image at once, front to back, which carries the bounds into alpha,
transmittance, weight and colour. On the way every decision whose distance from its threshold is within reach of
rounding is noted as near its threshold: elsewhere integers must match the oracle exactly. `pop_ref.margins` measures
the same distances one by one and in its own way; a test holds the two against each other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pop_ref.camera import camera_center, covars_cam_from_covars, in_front, means_cam_from_means, view_dirs
from pop_ref.conformance.scenes import Scene
from pop_ref.covariance import covars_from_quats_scales, rotmats_from_quats
from pop_ref.footprint import compensations, conics_from_covars2d, low_pass
from pop_ref.harmonics import colors_from_sh, sh_basis
from pop_ref.magnitudes import in_float32
from pop_ref.projection import project_covars, project_means, projection_jacobians

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
    size = scene.side
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
    half = 0.5 * scene.side
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


TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class ScreenErrorBounds:
    """Screen quantities in float64 with their error bounds; rows behind the near plane are left at zero.

    Attributes:
        kept: in front of the near plane with a positive determinant. [N]
        near: the near plane's decision is within `reach` (D1). [N]
        kinked: a frustum clamp or a colour clamp is within `reach` (B1, B2). [N]
        depths, e_depths: camera z. [N]
        means2d, e_means2d: px. [N, 2]
        conics, e_conics: px^-2. [N, 3]
        det, e_det: determinant of the blurred screen covariance, px^4. [N]
        opacities, e_opacities: that blend. [N]
        colors, e_colors: before and after the clamp at 0. [N, 3]
        means_cam, covars_cam, jacobians, covars2d: intermediate values, and e_ of each, for gradients.
    """

    kept: np.ndarray
    near: np.ndarray
    kinked: np.ndarray
    depths: np.ndarray
    e_depths: np.ndarray
    means2d: np.ndarray
    e_means2d: np.ndarray
    conics: np.ndarray
    e_conics: np.ndarray
    det: np.ndarray
    e_det: np.ndarray
    opacities: np.ndarray
    e_opacities: np.ndarray
    colors: np.ndarray
    e_colors: np.ndarray
    means_cam: np.ndarray
    e_means_cam: np.ndarray
    covars_cam: np.ndarray
    e_covars_cam: np.ndarray
    jacobians: np.ndarray
    e_jacobians: np.ndarray
    covars2d: np.ndarray
    e_covars2d: np.ndarray


def swapped(matrices: np.ndarray) -> np.ndarray:
    """Return transposed matrices of a stack."""
    return np.swapaxes(matrices, -1, -2)


def _in_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64) == values


def _camera_error_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return e(means_cam) and e(covars_cam)."""
    g, viewmat = scene.gaussians, scene.camera.viewmat
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    terms = np.concatenate([R[None] * g.means[:, None, :], np.broadcast_to(t[:, None], (len(g), 3, 1))], axis=2)
    # sums of short dyadic numbers are exact in any precision: only so can depths tie on purpose
    exact = np.all(_in_float32(terms) & _in_float32(np.cumsum(terms, axis=2)), axis=2)
    e_means_cam = np.where(exact, 0.0, 2.0 * np.sum(np.abs(terms), axis=2))
    A = np.abs(rotmats_from_quats(g.quats))
    variances = g.scales[:, None, :] ** 2
    e_covars = 4.0 * (A * variances) @ swapped(A) + 2.0 * (
        np.sum(A * variances, 2)[:, :, None] + np.sum(A * variances, 2)[:, None, :]
    )
    covars = np.abs(covars_from_quats_scales(g.quats, g.scales))
    return e_means_cam, np.abs(R) @ (e_covars + 4.0 * covars) @ np.abs(R).T


def _jacobian_error_bounds(means_cam: np.ndarray, e: np.ndarray, J: np.ndarray) -> np.ndarray:
    z = np.maximum(np.abs(means_cam[:, 2]), TINY)
    relative = e[:, 2] / z + 2.0
    e_J = np.abs(J) * relative[:, None, None]
    for axis in range(2):
        focal_over_z = np.abs(J[:, axis, axis])
        e_J[:, axis, 2] = 2.0 * np.abs(J[:, axis, 2]) * relative + focal_over_z * (e[:, axis] / z)
    return e_J


def _conic_error_bounds(covars2d: np.ndarray, e_covars2d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b, c = covars2d[:, 0, 0], np.abs(covars2d[:, 0, 1]), covars2d[:, 1, 1]
    e_a, e_b, e_c = e_covars2d[:, 0, 0], e_covars2d[:, 0, 1], e_covars2d[:, 1, 1]
    det = covars2d[:, 0, 0] * covars2d[:, 1, 1] - covars2d[:, 0, 1] * covars2d[:, 1, 0]
    e_det = c * e_a + a * e_c + 2.0 * b * e_b + a * c + b * b
    safe = np.where(det > 0.0, det, np.inf)
    e_conics = np.stack([(e + x * (e_det / safe + 2.0)) / safe for x, e in ((c, e_c), (b, e_b), (a, e_a))], axis=1)
    return det, e_det, e_conics


def _color_error_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours, their error bounds, and the sums before the clamp at 0."""
    g = scene.gaussians
    degree = scene.degree
    n_sh = (degree + 1) ** 2
    dirs = view_dirs(g.means, scene.camera.viewmat)
    length = np.maximum(np.linalg.norm(dirs, axis=1), TINY)
    basis = sh_basis(dirs / length[:, None], degree)
    center = np.linalg.norm(scene.camera.viewmat[:3, 3]) + np.linalg.norm(camera_center(scene.camera.viewmat))
    # a unit direction moves by eps (|mean| + 2 |center|) / distance, a basis function by at most 2 degree^2 times that
    e_dirs = (np.linalg.norm(g.means, axis=1) + 2.0 * center) / length + 4.0
    e_basis = 4.0 * np.abs(basis) + (2.0 * degree**2 * e_dirs)[:, None]
    e_colors = np.einsum("nk,nkc->nc", e_basis, np.abs(g.sh[:, :n_sh])) + 1.0
    sums = np.einsum("nk,nkc->nc", basis, g.sh[:, :n_sh]) + 0.5
    return colors_from_sh(g.sh, dirs, degree), e_colors, sums


def _clamp_in_reach(scene: Scene, p: np.ndarray, e_p: np.ndarray, reach: float) -> np.ndarray:
    """Tell whose x/z or y/z is within reach of the frustum clamp (B1)."""
    camera, profile = scene.camera, scene.profile
    near = np.zeros(len(p), dtype=bool)
    for axis, size in ((0, camera.width), (1, camera.height)):
        f = camera.K[axis, axis]
        c = 0.5 * size if profile.principal_point == "centred" else camera.K[axis, 2]
        margin = profile.frustum_margin * 0.5 * size / f
        slope = p[:, axis] / p[:, 2]
        e_slope = (e_p[:, axis] + np.abs(slope) * e_p[:, 2]) / p[:, 2] + np.abs(slope)
        for limit in (-(c / f + margin), (size - c) / f + margin):
            near |= np.abs(slope - limit) <= reach * (e_slope + (np.abs(c) + size) / f)
    return near


def screen_error_bounds(scene: Scene, reach: float) -> ScreenErrorBounds:
    """Carry error bounds from the scene to the screen; note decisions within reach of them."""
    g, camera, profile = scene.gaussians, scene.camera, scene.profile
    N = len(g)
    e_p, e_S = _camera_error_bounds(scene)
    p = means_cam_from_means(g.means, camera.viewmat)
    kept = in_front(p[:, 2], profile)
    depths = p[:, 2]
    # the constant itself may have to be rounded
    e_plane = 0.0 if in_float32(profile.near_plane) else profile.near_plane
    near = np.abs(depths - profile.near_plane) <= reach * (e_p[:, 2] + e_plane)
    # rows behind the camera take no part; a harmless point in their place keeps every formula finite
    p = np.where((kept | near)[:, None], p, np.array([0.0, 0.0, 1.0]))
    z = p[:, 2]
    means2d = project_means(p, camera.K, camera.width, camera.height, profile)
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    shift = means2d - focal * p[:, :2] / z[:, None]
    slopes = np.abs(focal * p[:, :2]) / z[:, None]
    e_means2d = (
        focal / z[:, None] * e_p[:, :2] + slopes * (e_p[:, 2] / z + 2.0)[:, None] + np.abs(shift) + np.abs(means2d)
    )
    S = covars_cam_from_covars(covars_from_quats_scales(g.quats, g.scales), camera.viewmat)
    J = projection_jacobians(p, camera.K, camera.width, camera.height, profile)
    e_J = _jacobian_error_bounds(p, e_p, J)
    A = np.abs(J)
    e_2d = A @ (e_S + 4.0 * np.abs(S)) @ swapped(A) + e_J @ np.abs(S) @ swapped(A) + A @ np.abs(S) @ swapped(e_J)
    raw = project_covars(S, J)
    covars2d = low_pass(raw, profile.eps2d)
    e_2d = e_2d + np.abs(covars2d)
    det, e_det, e_conics = _conic_error_bounds(covars2d, e_2d)
    opacities, e_opacities = g.opacities, g.opacities.copy()
    if scene.antialiased:
        opacities, e_opacities = _antialiased(g.opacities, raw, e_2d, det, e_det, profile.eps2d)
    colors, e_colors, sums = _color_error_bounds(scene) if N else (np.zeros((0, 3)),) * 3
    kinked = _clamp_in_reach(scene, p, e_p, reach) | np.any(np.abs(sums) <= reach * e_colors, axis=1)
    return ScreenErrorBounds(
        kept=kept & (det > 0.0), near=near, kinked=kinked, depths=depths, e_depths=e_p[:, 2],
        means2d=means2d, e_means2d=e_means2d, conics=conics_from_covars2d(covars2d), e_conics=e_conics,
        det=det, e_det=e_det, opacities=opacities, e_opacities=e_opacities, colors=colors, e_colors=e_colors,
        means_cam=p, e_means_cam=e_p, covars_cam=S, e_covars_cam=e_S, jacobians=J, e_jacobians=e_J,
        covars2d=covars2d, e_covars2d=e_2d,
    )  # fmt: skip


def _antialiased(
    opacities: np.ndarray, raw: np.ndarray, e_2d: np.ndarray, det: np.ndarray, e_det: np.ndarray, eps2d: float
) -> tuple[np.ndarray, np.ndarray]:
    factors = compensations(raw, eps2d)
    raw_det, e_raw_det, _ = _conic_error_bounds(raw, e_2d)
    relative = e_raw_det / np.maximum(raw_det, TINY) + e_det / np.maximum(det, TINY) + 4.0
    # near zero sqrt(max(0, x)) is wrong by the root of x's error, which no multiple of eps bounds: let it be huge
    return opacities * factors, opacities * factors * np.minimum(relative, 1e30)
