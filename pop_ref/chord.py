"""Where a ray passes the middle of a Gaussian: Mini-Splatting's depth, from which it sets its points anew.

Seen along a ray o + t d a Gaussian's density is exp(-|a + t b|^2 / 2) with a = diag(1/s) R^T (o - mean) and
b = diag(1/s) R^T d. It peaks at t* = -(a . b) / (b . b), which is also the middle of the chord that any level set of
the density cuts out of the ray, however many standard deviations wide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.camera import camera_center
from pop_ref.constants import PAPER, Profile
from pop_ref.covariance import rotmats_from_quats
from pop_ref.dominance import dominant_id
from pop_ref.pixel import composite_pixel, rows_from_splats
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.tiles import listed_pixels


@dataclass(frozen=True)
class DominantPoints:
    """What each pixel's ray meets first and foremost.

    Attributes:
        points: on the rays, world units; 0 where no Gaussian competes. [H, W, 3]
        ids: the Gaussian that the point belongs to, -1 where none competes. [H, W]
        T_final: transmittance after the last blended splat, competing or not. [H, W]
    """

    points: Float64[np.ndarray, "H W 3"]
    ids: Int64[np.ndarray, "H W"]
    T_final: Float64[np.ndarray, "H W"]


def chord_midpoint(
    mean: Float64[np.ndarray, "3"],
    quat: Float64[np.ndarray, "4"],
    scale: Float64[np.ndarray, "3"],
    origin: Float64[np.ndarray, "3"],
    direction: Float64[np.ndarray, "3"],
) -> float:
    """Find where along a ray a Gaussian is densest: `t* = -(a . b) / (b . b)`, as the module's text says.

    Source: Fang and Wang 2024 (Mini-Splatting), depth reinitialization.
    Departs: the code takes the middle of the chord through the ellipsoid of 3 standard deviations; the 3 cancels.

    Args:
        mean: centre, world units.
        quat: wxyz, any norm > 0.
        scale: standard deviations, world units, > 0.
        origin: of the ray, world units.
        direction: of the ray, any norm > 0.

    Returns:
        t*, in lengths of `direction`; negative behind the origin.

    Raises:
        ValueError: a scale is not over 0.

    Example:
        >>> a = np.array
        >>> chord_midpoint(a([1.0, 0.0, 4.0]), a([1.0, 0, 0, 0]), a([1.0, 1.0, 2.0]), np.zeros(3), a([0.0, 0.0, 1.0]))
        4.0
    """
    if np.any(~(scale > 0.0)):
        raise ValueError(f"scale is {scale.tolist()}; each must be > 0")
    R = rotmats_from_quats(quat[None])[0]
    a = R.T @ (origin - mean) / scale
    b = R.T @ direction / scale
    return -float(a @ b) / float(b @ b)


def dominant_points(
    splats: Splats,
    lists: list[list[int]],
    gaussians: Gaussians,
    camera: Camera,
    tile_size: int,
    profile: Profile = PAPER,
) -> DominantPoints:
    """Find each pixel's point: that of the blended Gaussian of the largest weight on the ray through its centre.

    `point = c + t* d` with c the camera's centre and d the unit direction. Gaussians that are densest behind the
    camera, `t* < 0`, or that have a scale of 0 and so no density, are blended and do not compete; ties go to the front
    (D8).

    Source: Fang and Wang 2024 (Mini-Splatting), depth reinitialization, and its code.
    Departs: the code divides by a scale of 0. It also leaves Gaussians that are densest behind the camera out of the
        light, so that what stands behind one has more weight there; here light is that of a render.

    Args:
        splats: the projected Gaussians.
        lists: ids front to back, one list a tile, row-major.
        gaussians: the same in the world.
        camera: the view.
        tile_size: px, the one the lists were made with.
        profile: floor, ceiling, stop, and which principal point is used.

    Returns:
        Points, ids and remaining light.

    Raises:
        ValueError: the lists do not fit.

    Example:
        >>> from pop_ref.render import render
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> camera = Camera(np.eye(4), np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]), 1, 1)
        >>> drawn = render(g, camera)
        >>> dominant_points(drawn.splats, drawn.tile_lists, g, camera, 16).points[0, 0] + 0.0
        array([0., 0., 4.])
    """
    width, height = camera.width, camera.height
    rows = rows_from_splats(splats)
    black = [0.0] * splats.colors.shape[1]
    origin = camera_center(camera.viewmat)
    points = np.zeros((height, width, 3))
    ids, T_final = np.full((height, width), -1, dtype=np.int64), np.zeros((height, width))
    for x, y, listed in listed_pixels(lists, width, height, tile_size):
        pixel = composite_pixel(listed, rows, x + 0.5, y + 0.5, black, profile)
        direction = _ray_direction(x + 0.5, y + 0.5, camera, profile)
        depth_of = {i: _depth_on_ray(gaussians, i, origin, direction) for i in pixel.ids}
        ahead = [(i, weight) for i, weight in zip(pixel.ids, pixel.weights, strict=True) if depth_of[i] >= 0.0]
        winner = dominant_id([i for i, _ in ahead], [weight for _, weight in ahead])
        if winner >= 0:
            points[y, x] = origin + depth_of[winner] * direction
        ids[y, x] = winner
        T_final[y, x] = pixel.T_final
    return DominantPoints(points, ids, T_final)


def _depth_on_ray(
    gaussians: Gaussians, i: int, origin: Float64[np.ndarray, "3"], direction: Float64[np.ndarray, "3"]
) -> float:
    """Give t* of one Gaussian, -inf where a scale of 0 leaves it without density."""
    if np.any(gaussians.scales[i] == 0.0):
        return -np.inf
    return chord_midpoint(gaussians.means[i], gaussians.quats[i], gaussians.scales[i], origin, direction)


def _ray_direction(px: float, py: float, camera: Camera, profile: Profile) -> Float64[np.ndarray, "3"]:
    K = camera.K
    cx, cy = float(K[0, 2]), float(K[1, 2])
    if profile.principal_point == "centred":
        cx, cy = 0.5 * camera.width, 0.5 * camera.height
    along = np.array([(px - cx) / K[0, 0], (py - cy) / K[1, 1], 1.0])
    return camera.viewmat[:3, :3].T @ along / np.sqrt(along @ along)
