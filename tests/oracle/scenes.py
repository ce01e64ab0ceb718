"""Small scenes for the oracle's own tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pop_ref import PAPER, Camera, Gaussians, Profile, margins, project
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
