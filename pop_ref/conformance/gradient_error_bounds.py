"""What rounding costs in gradients, and in the scores of pruning and budgeting methods.

Gradients are bounded by the backward pass on absolute values. Every cotangent carries a pair: an upper bound m of its
terms' absolute sum, and an error bound e in units of eps. The rule is that of `error_bounds`: a product a v costs
`|a| e(v) + e(a) m(v) + |a| m(v)`. Sums over pixels may be taken about a tile's centre, so an offset counts as itself
plus half a tile.

Scores are sums over pixels of products of bounded terms. The functions that are judged take splats and tile lists;
these are the oracle's, rounded to the backend's precision, so the error bounds of a whole render bound theirs. A
Gaussian is compared where every pixel that it may reach is unambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pop_ref.camera import camera_center
from pop_ref.conformance.adapter import projected
from pop_ref.conformance.assertions import with_error_bounds
from pop_ref.conformance.error_bounds import TINY, Layer, PixelErrorBounds, ScreenErrorBounds, swapped
from pop_ref.conformance.scenes import Scene, rounded
from pop_ref.covariance import covars_from_quats_scales, rotmats_from_quats
from pop_ref.records import Splats

# of what a splat has of each
_WIDTHS = {"means2d": (2,), "conics": (3,), "opacities": (), "colors": (3,)}


@dataclass
class Bound:
    """A bound of absolute values and its error bound in units of eps; arithmetic follows the module's rule."""

    m: np.ndarray
    e: np.ndarray

    def __add__(self, other: Bound) -> Bound:
        return Bound(self.m + other.m, self.e + other.e)

    def times(self, a: np.ndarray | float, e_a: np.ndarray | float | None = None) -> Bound:
        """Return the product with a known factor, whose own error bound defaults to its rounding."""
        size = np.abs(a)
        return Bound(size * self.m, size * self.e + (size if e_a is None else e_a + size) * self.m)

    def summed(self, axis: tuple[int, ...] | int) -> Bound:
        """Return the sum along axes, one more unit of the whole for the additions."""
        m = np.sum(self.m, axis=axis)
        return Bound(m, np.sum(self.e, axis=axis) + m)

    def between(self, left: np.ndarray, right: np.ndarray, e_left: np.ndarray, e_right: np.ndarray) -> Bound:
        """Return the matrix product left . self . right of stacks, all absolute values."""
        m = left @ self.m @ right
        return Bound(m, left @ self.e @ right + e_left @ self.m @ right + left @ self.m @ e_right + 4.0 * m)

    @property
    def error_bound(self) -> np.ndarray:
        """Return what a comparison allows: the error's units and one of the bound itself."""
        return self.e + self.m


def gradient_error_bounds(
    scene: Scene,
    error_bounds: PixelErrorBounds,
    v_image: np.ndarray,
    v_T_final: np.ndarray,
    plain: int = 0,
    with_depth: bool = False,
    e_cotangents: tuple[np.ndarray, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Return the error bound of every gradient by name, in units of eps.

    Args:
        scene: what is drawn.
        error_bounds: of the scene, with the same channels as the cotangent.
        v_image: cotangent of the image. [H, W, D]
        v_T_final: cotangent of the remaining transmittance. [H, W]
        plain: how many of the first channels are plain colours; with none, they are of harmonics.
        with_depth: whether the last channel is depth.
        e_cotangents: the error bounds of the two cotangents themselves, in units of eps; None where they are exact.
    """
    rows, background = sums_over_pixels(scene, error_bounds, v_image, v_T_final)
    if e_cotangents is not None:
        # what is off in a cotangent is off by as much as the same cotangent would weigh
        off, behind = sums_over_pixels(scene, error_bounds, *e_cotangents)
        rows = {name: Bound(bound.m, bound.e + off[name].m) for name, bound in rows.items()}
        background = background + behind
    return error_bounds_of_sums(scene, error_bounds.screen, rows, background, plain, with_depth)


def sums_over_pixels(
    scene: Scene, error_bounds: PixelErrorBounds, v_image: np.ndarray, v_T_final: np.ndarray
) -> tuple[dict[str, Bound], np.ndarray]:
    """Bound the cotangents of splats, by name, and the error bound of the background's; windows of one image add up."""
    N = len(scene.gaussians)
    pixels = _pixel_bounds(scene, error_bounds, np.abs(v_image), np.abs(v_T_final), 0.5 * scene.side)
    T = error_bounds.layers[-1].T_after if error_bounds.layers else np.ones(v_T_final.shape)
    background = np.einsum("hw,hwc->c", 2.0 * T + error_bounds.T_final, np.abs(v_image))
    shapes = {"means2d": (2,), "conics": (3,), "opacities": (), "colors": v_image.shape[2:]}
    return {name: _gather(values, (N, *shapes[name])) for name, values in pixels.items()}, background


def error_bounds_of_sums(
    scene: Scene,
    screen: ScreenErrorBounds,
    rows: dict[str, Bound],
    background: np.ndarray,
    plain: int = 0,
    with_depth: bool = False,
) -> dict[str, np.ndarray]:
    """Return the error bound of every gradient by name from what `sums_over_pixels` found."""
    rows = dict(rows)
    given, nothing = rows["colors"], np.zeros((len(scene.gaussians), 3))
    if with_depth:
        rows["depths"] = Bound(given.m[:, -1], given.e[:, -1])
    if plain or given.m.shape[1] - with_depth == 0:
        rows["colors"] = Bound(nothing, nothing)
    elif with_depth:
        rows["colors"] = Bound(given.m[:, :-1], given.e[:, :-1])
    found = _world_bounds(scene, screen, rows)
    found["colors"] = given.error_bound[:, :plain]
    found["background"] = background
    found["means2d"] = found["means2d_abs"] = rows["means2d"].error_bound
    return found


def _gather(values: dict[int, Bound], shape: tuple[int, ...]) -> Bound:
    total = Bound(np.zeros(shape), np.zeros(shape))
    for i, value in values.items():
        total.m[i], total.e[i] = value.m, value.e
    return total


def _pixel_bounds(
    scene: Scene, error_bounds: PixelErrorBounds, v: np.ndarray, v_T: np.ndarray, half_tile: float
) -> dict[str, dict[int, Bound]]:
    s = error_bounds.screen
    out: dict[str, dict[int, Bound]] = {"means2d": {}, "conics": {}, "opacities": {}, "colors": {}}
    # of the channels that are drawn: depth has a background of 0
    size = v_T + v @ np.abs(error_bounds.scene.background)
    suffix_dot_grad = Bound(size, 2.0 * size)
    for layer in reversed(error_bounds.layers):
        i, shown = layer.id, layer.blended.astype(np.float64)
        T, T_error, alpha, e_alpha = (layer.T, layer.T_error, layer.alpha, layer.e_alpha)
        weight = _weight(layer)
        out["colors"][i] = Bound(weight.m[..., None] * v, (weight.e + weight.m)[..., None] * v).summed((0, 1))
        color_dot_grad = Bound(v @ np.abs(s.colors[i]), v @ s.e_colors[i] + 2.0 * v @ np.abs(s.colors[i]))
        v_alpha = (color_dot_grad + suffix_dot_grad).times(T * shown, T_error * shown)
        step = color_dot_grad.times(alpha, e_alpha) + suffix_dot_grad.times(1.0 - alpha, e_alpha)
        suffix_dot_grad = Bound(
            np.where(shown > 0, step.m, suffix_dot_grad.m), np.where(shown > 0, step.e, suffix_dot_grad.e)
        )
        if scene.profile.ceiling_gradient == "zero":
            v_alpha = v_alpha.times(np.where(layer.raw > scene.profile.alpha_ceiling, 0.0, 1.0))
        raw = layer.raw
        falloff = raw / max(float(s.opacities[i]), TINY)
        out["opacities"][i] = v_alpha.times(falloff, falloff * layer.e_sigma).summed((0, 1))
        v_sigma = v_alpha.times(raw, raw * layer.e_sigma + raw)
        slopes = [slope.summed((0, 1)) for slope in exponent_slopes(layer, s, v_sigma, half_tile)]
        out["means2d"][i], out["conics"][i] = _stack(*slopes[:2]), _stack(*slopes[2:])
    return out


def exponent_slopes(layer: Layer, s: ScreenErrorBounds, v_sigma: Bound, half_tile: float) -> list[Bound]:
    """Bound what a cotangent of the exponent is worth to (mean2d x, y, conic xx, xy, yy) at each pixel. [H, W] each"""
    dx, dy = np.abs(layer.dx) + half_tile, np.abs(layer.dy) + half_tile
    e_dx, e_dy = layer.e_dx + half_tile, layer.e_dy + half_tile
    A, B, C = np.abs(s.conics[layer.id])
    e_A, e_B, e_C = s.e_conics[layer.id]
    factors = (
        (A * dx + B * dy, e_A * dx + A * e_dx + e_B * dy + B * e_dy),
        (B * dx + C * dy, e_B * dx + B * e_dx + e_C * dy + C * e_dy),
        (0.5 * dx * dx, dx * e_dx),
        (dx * dy, dx * e_dy + dy * e_dx),
        (0.5 * dy * dy, dy * e_dy),
    )
    return [v_sigma.times(a, e_a) for a, e_a in factors]


def parameter_error_bounds(scene: Scene, s: ScreenErrorBounds) -> np.ndarray:
    """Bound the rounding of the derivatives of (mean2d, conic, colour) by (mean, log scale). [N, 8, 6]"""
    n = len(scene.gaussians)
    error_bounds = np.zeros((n, 8, 6))
    for row in range(8 * (n > 0)):
        v = np.zeros((n, 8))
        v[:, row] = 1.0
        parts = {"means2d": v[:, :2], "conics": v[:, 2:5], "opacities": np.zeros(n), "colors": v[:, 5:]}
        found = _world_bounds(scene, s, {name: Bound(part, np.zeros_like(part)) for name, part in parts.items()})
        error_bounds[:, row] = np.concatenate([found["means"], found["scales"] * scene.gaussians.scales], axis=1)
    return error_bounds


def _stack(*bounds: Bound) -> Bound:
    return Bound(np.array([b.m for b in bounds]), np.array([b.e for b in bounds]))


def _matrix(conics: np.ndarray, half: float = 1.0) -> np.ndarray:
    xx, xy, yy = conics[:, 0], half * conics[:, 1], conics[:, 2]
    return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)


def _world_bounds(scene: Scene, s: ScreenErrorBounds, rows: dict[str, Bound]) -> dict[str, np.ndarray]:
    g, camera = scene.gaussians, scene.camera
    R = np.abs(camera.viewmat[:3, :3])
    Q, e_Q = np.abs(_matrix(s.conics)), _matrix(s.e_conics)
    V = Bound(_matrix(rows["conics"].m, 0.5), _matrix(rows["conics"].e, 0.5)).between(Q, Q, e_Q, e_Q)
    opacity = rows["opacities"].times(
        s.opacities / np.maximum(g.opacities, TINY), s.e_opacities / np.maximum(g.opacities, TINY)
    )
    if scene.antialiased:
        V = V + _antialiasing(rows["opacities"], s)
    A, e_A, S, e_S = np.abs(s.jacobians), s.e_jacobians, np.abs(s.covars_cam), s.e_covars_cam
    v_S = V.between(swapped(A), A, swapped(e_A), e_A)
    AS, e_AS = A @ S, e_A @ S + A @ e_S
    v_J = Bound(2.0 * V.m @ AS, 2.0 * (V.e @ AS + V.m @ e_AS + 4.0 * V.m @ AS))
    v_p = _point_bound(s, camera.K, rows["means2d"], v_J)
    if "depths" in rows:
        v_p.m[:, 2] += rows["depths"].m
        v_p.e[:, 2] += rows["depths"].e
    v_dirs, sh = _color_bounds(scene, rows["colors"])
    v_means = Bound(v_p.m @ R + v_dirs.m, v_p.e @ R + 4.0 * v_p.m @ R + v_dirs.e)
    v_covars = v_S.between(swapped(R)[None], R[None], np.zeros((1, 3, 3)), np.zeros((1, 3, 3)))
    quats, scales = _shape_bounds(scene, v_covars)
    viewmat = _viewmat_bound(scene, v_p, v_S, v_dirs)
    return {
        "means": v_means.error_bound,
        "quats": quats,
        "scales": scales,
        "opacities": opacity.error_bound,
        "sh": sh,
        "viewmat": viewmat,
    }


def _antialiasing(v_opacities: Bound, s: ScreenErrorBounds) -> Bound:
    # v_Sigma = v_rho rho / 2 (raw^-1 - blurred^-1); the raw inverse is bounded by the conic over the squared factor
    factor = np.minimum(s.e_opacities / np.maximum(s.opacities, TINY), 1e15)
    spread = np.abs(_matrix(s.conics)) * factor[:, None, None]
    m = (v_opacities.m * s.opacities)[:, None, None] * spread
    return Bound(m, m * (factor[:, None, None] + 4.0) + (v_opacities.e * s.opacities)[:, None, None] * spread)


def _point_bound(s: ScreenErrorBounds, K: np.ndarray, v_means2d: Bound, v_J: Bound) -> Bound:
    z, e_z = s.means_cam[:, 2], s.e_means_cam[:, 2]
    total = Bound(np.zeros((len(z), 3)), np.zeros((len(z), 3)))
    for axis in range(2):
        f, x, e_x = K[axis, axis], np.abs(s.means_cam[:, axis]), s.e_means_cam[:, axis]
        tx = np.abs(s.jacobians[:, axis, 2]) * z * z / f
        near = e_z / z
        v_u = Bound(v_means2d.m[:, axis], v_means2d.e[:, axis])
        v_diagonal = Bound(v_J.m[:, axis, axis], v_J.e[:, axis, axis])
        v_offset = Bound(v_J.m[:, axis, 2], v_J.e[:, axis, 2])
        side = v_u.times(f / z, f / z * near) + v_offset.times(f / z**2, 2.0 * f / z**2 * near)
        ahead = (
            v_u.times(f * x / z**2, f * (e_x + 2.0 * x * near) / z**2)
            + v_diagonal.times(f / z**2, 2.0 * f / z**2 * near)
            + v_offset.times(2.0 * f * tx / z**3, 2.0 * f * (e_x + 4.0 * tx * near) / z**3)
        )
        total.m[:, axis] += side.m
        total.e[:, axis] += side.e
        total.m[:, 2] += ahead.m
        total.e[:, 2] += ahead.e
    return total


def _color_bounds(scene: Scene, v_colors: Bound) -> tuple[Bound, np.ndarray]:
    g = scene.gaussians
    degree = scene.degree
    n_sh = (degree + 1) ** 2
    center = camera_center(scene.camera.viewmat)
    dirs = g.means - center
    length = np.maximum(np.linalg.norm(dirs, axis=1), TINY)
    e_dirs = (np.linalg.norm(g.means, axis=1) + 3.0 * np.linalg.norm(center)) / length + 4.0
    # no basis function of band l exceeds sqrt((2 l + 1) / 4 pi), no gradient l times that, by 2 over all components
    height = np.sqrt((2.0 * np.floor(np.sqrt(np.arange(n_sh))) + 1.0) / (4.0 * np.pi))
    basis = Bound(np.broadcast_to(height, (len(g), n_sh)), height * (1.0 + 2.0 * degree * e_dirs[:, None]))
    sh = np.zeros(g.sh.shape)
    sh[:, :n_sh] = basis.m[..., None] * v_colors.error_bound[:, None] + basis.e[..., None] * v_colors.m[:, None]
    color_dot_grad = np.einsum("nkc,nc->n", np.abs(g.sh[:, :n_sh]), v_colors.m)
    e_color_dot_grad = np.einsum("nkc,nc->n", np.abs(g.sh[:, :n_sh]), v_colors.e)
    slope = 2.0 * degree * np.max(height) / length
    m = slope * color_dot_grad
    e = slope * (e_color_dot_grad + color_dot_grad * (2.0 * degree * e_dirs + 4.0))
    return Bound(np.repeat(m[:, None], 3, 1), np.repeat(e[:, None], 3, 1)), sh


def _shape_bounds(scene: Scene, v_covars: Bound) -> tuple[np.ndarray, np.ndarray]:
    g = scene.gaussians
    A = np.abs(rotmats_from_quats(g.quats))
    M, e_M = A * g.scales[:, None, :], 2.0 * (A + 1.0) * g.scales[:, None, :]
    v_M = Bound(2.0 * v_covars.m @ M, 2.0 * (v_covars.e @ M + v_covars.m @ e_M + 2.0 * v_covars.m @ M))
    v_scales = v_M.times(A, 2.0 * (A + 1.0)).summed(1)
    v_R = v_M.times(g.scales[:, None, :])
    length = np.linalg.norm(g.quats, axis=1, keepdims=True)
    units = np.abs(g.quats) / length
    slopes = _rotation_slopes(units)
    m, e = (np.einsum("nkij,nij->nk", slopes, v) for v in (v_R.m, v_R.e))
    # the slopes' own rounding, and that of the radial part, which is projected out
    e = e + 4.0 * m
    radial = np.sum(units * (e + 4.0 * m), axis=1, keepdims=True)
    return (e + units * radial) / length, v_scales.error_bound


def _rotation_slopes(units: np.ndarray) -> np.ndarray:
    """Bound dR/du by the entries of absolute unit quaternions, however the diagonal is written. [N, 4, 3, 3]"""
    w, x, y, z = units.T
    rows = (
        ((w, z, y), (z, w, x), (y, x, w)),
        ((x, y, z), (y, 2 * x, w), (z, w, 2 * x)),
        ((2 * y, x, w), (x, y, z), (w, z, 2 * y)),
        ((2 * z, w, x), (w, 2 * z, y), (x, y, z)),
    )
    return 2.0 * np.moveaxis(np.array(rows), 3, 0)


def _viewmat_bound(scene: Scene, v_p: Bound, v_S: Bound, v_dirs: Bound) -> np.ndarray:
    g, viewmat = scene.gaussians, scene.camera.viewmat
    R, t = np.abs(viewmat[:3, :3]), np.abs(viewmat[:3, 3])
    covars = np.abs(covars_from_quats_scales(g.quats, g.scales)) + np.max(g.scales, axis=1)[:, None, None] ** 2
    error_bound = np.zeros((4, 4))
    error_bound[:3, :3] = np.sum(v_p.error_bound[:, :, None] * np.abs(g.means)[:, None, :], 0)
    error_bound[:3, :3] += np.sum(2.0 * v_S.error_bound @ R @ covars, 0) + np.outer(t, np.sum(v_dirs.error_bound, 0))
    error_bound[:3, 3] = np.sum(v_p.error_bound, 0) + R @ np.sum(v_dirs.error_bound, 0)
    return error_bound


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
    sure, smooth = (_clear_rows(error_bounds, where) for where in (error_bounds.unambiguous, error_bounds.smooth))
    splats = replace(splats, **dict(zip(columns, near, strict=True)))
    return Screened(seen, splats, lists, seen.side, error_bounds, sure, smooth)


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
