"""Put the world of a capture into the frame that gsplat trains in, and remember how; and where its cameras look.

Three steps, each one similarity: (1) turn the mean up direction of the cameras to -y, put the origin at the median of
the points of the optical axes that are nearest to the capture's origin, and scale the median camera distance to 1;
(2) turn the principal axes of the sparse points to x, y, z in order of falling variance, origin at their median;
(3) turn half round about x where the points lie above their middle, because a scene has more points near its floor.

Source: gsplat v1.5.3, examples/datasets/normalize.py and colmap.py. Departs: the signs of the principal axes, which
gsplat leaves to LAPACK, are fixed so that the largest entry of the x and y axes is positive.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from pop_fast.errors import CaptureError

# of a point from the middle of all, times the median camera distance
_FARTHEST = 1e100


def transform_points(transform: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Move points by a similarity: p' = s R p + t. float64 [P, 3]"""
    return points @ transform[:3, :3].T + transform[:3, 3]


def transform_viewmats(transform: np.ndarray, viewmats: np.ndarray) -> np.ndarray:
    """Move cameras [V, 4, 4] by a similarity of the world [4, 4], and keep their view matrices rigid.

    With R, s, t of the similarity and c' = s R c + t the new centre: rotation' = rotation R^T, viewmat' = [rotation',
    -rotation' c'].
    """
    linear = transform[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    rotations = viewmats[:, :3, :3] @ (linear / scale).T
    centers = transform_points(transform, camera_centers(viewmats))
    moved = viewmats.copy()
    moved[:, :3, :3] = rotations
    moved[:, :3, 3] = -np.einsum("vij,vj->vi", rotations, centers)
    return moved


def normalizing_transform(viewmats: np.ndarray, points: np.ndarray | None) -> np.ndarray:
    """Find the similarity, normalised world from the capture's own, by viewmats [V, 4, 4] and sparse points [P, 3].

    Without points, or with fewer than four, only step (1) is taken.

    Raises:
        CaptureError: the cameras have no extent or no common up direction, or points are too far away.
    """
    transform = _from_cameras(viewmats)
    if points is None or len(points) < 4:
        return transform
    transform = _principal_axes(transform_points(transform, points)) @ transform
    heights = transform_points(transform, points)[:, 2]
    if np.median(heights) > np.mean(heights):
        transform = np.diag([1.0, -1.0, -1.0, 1.0]) @ transform
    return transform


def camera_centers(viewmats: np.ndarray) -> np.ndarray:
    """Give the cameras' centres in the world: c = -R^T t. [V, 3]"""
    return -np.einsum("vji,vj->vi", viewmats[:, :3, :3], viewmats[:, :3, 3])


def focus_point(viewmats: np.ndarray) -> np.ndarray:
    """Give the point nearest to all optical axes: sum_i (I - d_i d_i^T)(x - c_i) = 0.

    Parallel axes meet nowhere, and those that spread meet behind the cameras; then it is the point one mean camera
    distance ahead of the cameras' mean.
    """
    centers, forward = camera_centers(viewmats), viewmats[:, 2, :3]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.cond(total) < 1e6:
        focus = np.linalg.solve(total, np.einsum("mij,mj->i", across, centers))
        if np.median(np.einsum("mj,mj->m", focus - centers, forward)) > 0.0:
            return focus
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean())
    return centers.mean(axis=0) + (spread or 1.0) * forward.mean(axis=0)


# four of five cameras of ten captures look past the point by up to 13 degrees where people went round a subject; by 49
# to 155 on a walk, in rooms photographed from their middle, and from the air
_LOOKS_AT: Final = np.radians(25.0)
_MOST_CAMERAS: Final = 0.8


def look_at_one_point(viewmats: np.ndarray) -> bool:
    """Tell whether four of five cameras look at `focus_point`, as those do that went round a subject. [V, 4, 4]"""
    rays = focus_point(viewmats) - camera_centers(viewmats)
    along = np.einsum("mj,mj->m", rays, viewmats[:, 2, :3])
    cosines = along / np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    return bool(np.mean(cosines >= np.cos(_LOOKS_AT)) >= _MOST_CAMERAS)


# degrees between neighbouring cameras from which what lies between them is guessed
FAR_APART: Final = 15.0


def nearest_cameras(viewmats: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the nearest other camera of each, as the point that they look at sees them, and the angle to it in degrees.

    [V] each; None of a single camera, and where they look at no one point.
    """
    if len(viewmats) < 2 or not look_at_one_point(viewmats):
        return None
    offsets = camera_centers(viewmats) - focus_point(viewmats)
    rays = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    cosines = rays @ rays.T
    np.fill_diagonal(cosines, -1.0)
    return cosines.argmax(axis=1), np.degrees(np.arccos(np.clip(cosines.max(axis=1), -1.0, 1.0)))


def neighbour_degrees(viewmats: np.ndarray) -> float | None:
    """Give the median of the angles of `nearest_cameras`, degrees; None where there are none."""
    found = nearest_cameras(viewmats)
    return None if found is None else float(np.median(found[1]))


def _from_cameras(viewmats: np.ndarray) -> np.ndarray:
    # the rows of a view matrix are the camera's axes in the world: x right, y down, z forward
    up = -viewmats[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(up)
    turn = _rotation_between(up / length, np.array([0.0, -1.0, 0.0])) if length > 1e-6 else np.eye(3)
    centers = camera_centers(viewmats) @ turn.T
    forwards = viewmats[:, 2, :3] @ turn.T
    nearest = centers - np.sum(forwards * centers, axis=1, keepdims=True) * forwards
    origin = np.median(nearest, axis=0)
    distance = float(np.median(np.linalg.norm(centers - origin, axis=1)))
    spread = float(np.ptp(centers, axis=0).max())
    if spread <= 1e-9 * max(1.0, float(np.abs(centers).max())) or distance == 0.0:
        raise CaptureError("all cameras stand at one place; a scene can only be made from photographs that moved")
    transform = np.eye(4)
    transform[:3, :3] = turn / distance
    transform[:3, 3] = -origin / distance
    return transform


def _rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotate unit vector a onto unit vector b by the shortest way: I + [v] + [v]^2 / (1 + a.b), v = a x b."""
    cosine = float(a @ b)
    if cosine <= -1.0 + 1e-12:
        return np.diag([-1.0, -1.0, 1.0])
    x, y, z = np.cross(a, b)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + cosine)


def _principal_axes(points: np.ndarray) -> np.ndarray:
    middle = np.median(points, axis=0)
    # the square of what is too far is no float
    farthest = float(np.abs(points - middle).max())
    if not farthest < _FARTHEST:
        raise CaptureError(
            f"in units of the cameras' distance, points lie up to {farthest:.3g} from their middle, which cannot be "
            "normalized; correct the positions of cameras and points, or use --no-normalize"
        )
    _, axes = np.linalg.eigh(np.cov(points - middle, rowvar=False))
    rotation = axes.T[::-1].copy()
    for row in rotation[:2]:
        if row[np.argmax(np.abs(row))] < 0.0:
            row *= -1.0
    rotation[2] = np.cross(rotation[0], rotation[1])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ middle
    return transform
