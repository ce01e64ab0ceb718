"""A renderer without tiles, stages or loops over pixels: whole arrays [N, H, W], in float64 or float32.

It shares no line with the oracle and follows the method section in another order: all alphas first, then sorting, then
prefix products, then the stop.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from pop_ref import Camera, Gaussians, Profile, Render, Splats


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
    """Render grey-band (degree 0) Gaussians with opacity-aware extents; those behind the near plane are left out."""
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
