"""Small scenes for the oracle's own tests, and a renderer of them without tiles, stages or loops over pixels."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from pop_ref import PAPER, Camera, Gaussians, Profile, Render, Splats, margins, project
from pop_ref.splatting import geometry

_FOUND: dict[object, Gaussians] = {}


def camera(width: int = 6, height: int = 5, focal: float = 7.0) -> Camera:
    """Look along +z from the origin, principal point off the middle."""
    K = np.array([[focal, 0.0, 0.5 * width + 0.25], [0.0, 1.25 * focal, 0.5 * height - 0.5], [0.0, 0.0, 1.0]])
    return Camera(np.eye(4), K, width, height)


def tilted_camera(width: int = 6, height: int = 5, focal: float = 7.0) -> Camera:
    """Look from elsewhere, about towards (0, 0, 4)."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_matrix()
    viewmat[:3, 3] = np.array([0.0, 0.0, 4.0]) - viewmat[:3, :3] @ np.array([0.1, -0.2, 4.0])
    return Camera(viewmat, camera(width, height, focal).K, width, height)


def loose_camera(like: Camera, viewmat: np.ndarray) -> Camera:
    """Take a view matrix that is not quite rigid, as differences along its entries need."""
    loose = Camera(like.viewmat, like.K, like.width, like.height)
    object.__setattr__(loose, "viewmat", viewmat)
    return loose


def random_gaussians(seed: int, n: int = 5, n_sh: int = 4) -> Gaussians:
    """Scatter Gaussians about (0, 0, 4) in all shapes, opacities and colours, the last one beyond the clamp (B1)."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(n, 3)) * [0.8, 0.6, 0.5] + [0.0, 0.0, 4.0]
    means[-1, 0] += 4.0
    return Gaussians(
        means=means,
        quats=rng.normal(size=(n, 4)) * rng.uniform(0.5, 2.0, size=(n, 1)),
        scales=np.exp(rng.normal(size=(n, 3)) * 0.5 - 0.5) + 1.5 * (np.arange(n) == n - 1)[:, None],
        opacities=rng.uniform(0.1, 0.95, size=n),
        sh=rng.normal(size=(n, n_sh, 3)) * 0.6,
    )


def safe_gaussians(
    view: Camera,
    n: int = 5,
    n_sh: int = 4,
    profile: Profile = PAPER,
    antialiased: bool = False,
    tolerance: float = 1e-5,
) -> Gaussians:
    """Find a random scene with every decision and kink at least the tolerance from flipping.

    In it some Gaussian is clamped to the frustum (B1) and some colour is clamped at 0 (B2).
    """
    key = (repr(view), n, n_sh, profile, antialiased, tolerance)
    for seed in range(300) if key not in _FOUND else ():
        gaussians = random_gaussians(seed, n, n_sh)
        nearest = margins(gaussians, view, profile=profile, antialiased=antialiased).nearest
        if (nearest is None or nearest.margin > tolerance) and _has_clamps(gaussians, view, profile):
            _FOUND[key] = gaussians
            break
    return _FOUND[key]


def _has_clamps(gaussians: Gaussians, view: Camera, profile: Profile) -> bool:
    splats = project(gaussians, view, profile=profile)
    seen = np.flatnonzero(splats.visible)
    shape = geometry(gaussians, view, profile)
    slopes = -shape.jacobians[seen, 0, 2] * shape.means_cam[seen, 2] / view.K[0, 0]
    clamped = np.abs(slopes - shape.means_cam[seen, 0] / shape.means_cam[seen, 2]) > 0.01
    return bool(np.any(clamped) and np.any(splats.colors[seen] == 0.0))


def dyadic_camera(width: int, height: int) -> Camera:
    """Project (x, y, 4) to (x + W/2, y + H/2) exactly."""
    K = np.array([[4.0, 0.0, 0.5 * width], [0.0, 4.0, 0.5 * height], [0.0, 0.0, 1.0]])
    return Camera(np.eye(4), K, width, height)


def grey(opacities: list[float], means: list[list[float]] | None = None, scale: float = 1.0) -> Gaussians:
    """Make isotropic grey Gaussians, by default on the centre of the middle pixel of an odd-sized image."""
    n = len(opacities)
    return Gaussians(
        means=np.array(means if means is not None else [[0.0, 0.0, 4.0]] * n).reshape(n, 3),
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.full((n, 3), scale),
        opacities=np.array(opacities, dtype=np.float64),
        sh=np.zeros((n, 1, 3)),
    )


class Dense(NamedTuple):
    """What `dense_render` finds."""

    image: np.ndarray
    T_final: np.ndarray
    dominant_ids: np.ndarray
    n_blended: np.ndarray
    radii: np.ndarray


def rotations(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    zero = np.zeros_like(w)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    # Rodrigues: R = I + 2 w [u]x + 2 [u]x^2
    return np.eye(3, dtype=quats.dtype) + 2 * w[:, None, None] * cross + 2 * cross @ cross


def dense_render(
    gaussians: Gaussians, camera: Camera, background: np.ndarray, profile: Profile, dtype: type = np.float64
) -> Dense:
    """Render grey-band (degree 0) Gaussians with opacity-aware extents; those behind the near plane are left out.

    It shares no line with the oracle and follows the method section in another order, in whole arrays [N, H, W]: all
    alphas first, then sorting, then prefix products, then the stop.
    """
    c = {name: dtype(value) for name, value in profile.__dict__.items() if isinstance(value, float)}
    means, quats, scales, opacities = (
        np.asarray(a, dtype=dtype) for a in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
    )
    V, K = camera.viewmat.astype(dtype), camera.K.astype(dtype)
    size = np.array([camera.width, camera.height], dtype=dtype)
    focal, principal = K[[0, 1], [0, 1]], K[:2, 2]

    p = means @ V[:3, :3].T + V[:3, 3]
    z = p[:, 2]
    front = (z >= c["near_plane"]) & (z <= c["far_plane"])
    safe_z = np.where(front, z, dtype(1))
    slopes = p[:, :2] / safe_z[:, None]
    margin = c["frustum_margin"] * dtype(0.5) * size / focal
    clamped = np.clip(slopes, -principal / focal - margin, (size - principal) / focal + margin)
    J = np.zeros((len(means), 2, 3), dtype=dtype)
    J[:, [0, 1], [0, 1]] = focal / safe_z[:, None]
    J[:, :, 2] = -focal * clamped / safe_z[:, None]
    half = rotations(quats) * scales[:, None, :]
    T = J @ V[:3, :3]
    covars = T @ (half @ half.swapaxes(1, 2)) @ T.swapaxes(1, 2) + c["eps2d"] * np.eye(2, dtype=dtype)
    a, b, d = covars[:, 0, 0], covars[:, 0, 1], covars[:, 1, 1]
    det = a * d - b * b
    means2d = slopes * focal + principal

    alive = front & (det > 0) & (opacities >= c["alpha_floor"])
    k = np.sqrt(2 * np.log(np.where(alive, opacities, dtype(1)) / c["alpha_floor"]))
    k = np.minimum(c["extent_sigmas"], k)
    radii = np.ceil(k[:, None] * np.sqrt(np.stack([a, d], axis=1)))
    alive &= np.all((radii > 0) & (means2d + radii > 0) & (means2d - radii < size), axis=1)
    radii[~alive] = 0

    order = np.lexsort((np.arange(len(z)), z))
    order = order[alive[order]]
    centres_x = np.arange(camera.width, dtype=dtype) + dtype(0.5)
    centres_y = np.arange(camera.height, dtype=dtype) + dtype(0.5)
    dx = (means2d[order, 0, None] - centres_x)[:, None, :]
    dy = (means2d[order, 1, None] - centres_y)[:, :, None]
    A, B, C = (v[order, None, None] for v in (d / det, -b / det, a / det))
    sigma = dtype(0.5) * (A * dx * dx + C * dy * dy) + B * dx * dy
    alphas = np.minimum(c["alpha_ceiling"], opacities[order, None, None] * np.exp(-np.maximum(sigma, 0)))
    alphas = np.where((sigma < 0) | (alphas < c["alpha_floor"]), dtype(0), alphas)

    shape = (1, camera.height, camera.width)
    after = np.cumprod(np.concatenate([np.ones(shape, dtype), 1 - alphas]), axis=0, dtype=dtype)
    stopped = (after <= c["transmittance_stop"]) if profile.stop_inclusive else (after < c["transmittance_stop"])
    blended = (alphas > 0) & ~np.maximum.accumulate(stopped, axis=0)[1:]
    weights = np.where(blended, after[:-1] * alphas, dtype(0))
    T_final = np.prod(np.where(blended, 1 - alphas, dtype(1)), axis=0, dtype=dtype)
    colors = np.maximum(gaussians.sh[order, 0].astype(dtype) * dtype(np.sqrt(1 / (4 * np.pi))) + dtype(0.5), 0)
    image = np.einsum("nhw,nc->hwc", weights, colors) + T_final[..., None] * background.astype(dtype)
    winners = np.concatenate([np.zeros(shape, dtype), weights]).argmax(axis=0)
    dominant_ids = np.concatenate([[-1], order])[winners]
    return Dense(image, T_final, dominant_ids, np.sum(blended, axis=0), radii.astype(np.int64))


class Blended(NamedTuple):
    """One blended splat of one pixel."""

    id: int
    T: float
    alpha: float


def blended_at(
    splats: Splats, lists: list[list[int]], width: int, tile_size: int, x: int, y: int, profile: Profile
) -> list[Blended]:
    """List the splats that pixel (x, y) blends, front to back."""
    ids = np.array(lists[(y // tile_size) * -(-width // tile_size) + x // tile_size], dtype=np.int64)
    d = splats.means2d[ids] - [x + 0.5, y + 0.5]
    Q = splats.conics[ids]
    sigma = 0.5 * (Q[:, 0] * d[:, 0] ** 2 + Q[:, 2] * d[:, 1] ** 2) + Q[:, 1] * d[:, 0] * d[:, 1]
    alphas = np.minimum(profile.alpha_ceiling, splats.opacities[ids] * np.exp(-sigma))
    part = (sigma >= 0.0) & (alphas >= profile.alpha_floor)
    ids, alphas = ids[part], alphas[part]
    after = np.cumprod(1.0 - alphas)
    stop = profile.transmittance_stop
    ends = np.flatnonzero(after <= stop if profile.stop_inclusive else after < stop)
    n = int(ends[0]) if len(ends) else len(ids)
    before = np.concatenate([[1.0], after])[:n]
    return list(itertools.starmap(Blended, zip(ids[:n].tolist(), before.tolist(), alphas[:n].tolist(), strict=True)))


def blended_pixels(drawn: Render, tile_size: int, profile: Profile) -> dict[tuple[int, int], list[Blended]]:
    """List the blended splats of every pixel of a render, by (x, y)."""
    height, width = drawn.T_final.shape
    return {
        (x, y): blended_at(drawn.splats, drawn.tile_lists, width, tile_size, x, y, profile)
        for y in range(height)
        for x in range(width)
    }
