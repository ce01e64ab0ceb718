"""Points to start from where a capture brings none: uniform in the cube around the cameras, where two of them look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pop_fast.data.capture import SparsePoints, View
from pop_fast.errors import CaptureError

__all__ = ["in_picture", "random_points"]

_ROUNDS = 20


def random_points(views: Sequence[View], count: int = 30_000, seed: int = 0) -> SparsePoints:
    """Draw points uniformly from the cameras' bounding cube, and keep those in the pictures of two views or more.

    The cube stands around the bounding box of the camera centres, with that box's longest side. Every point gets the
    mean colour of the photographs.

    Args:
        views: with their cameras in the world that the points shall be in.
        count: how many points to make.
        seed: of the generator.

    Raises:
        CaptureError: no two views look at a common part of the cube.
    """
    centers = np.stack([view.camera_center for view in views])
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    half = 0.5 * float(np.ptp(centers, axis=0).max())
    generator = np.random.default_rng(seed)
    kept: list[np.ndarray] = []
    for _ in range(_ROUNDS):
        points = middle + half * generator.uniform(-1.0, 1.0, (count, 3))
        kept.append(points[_times_seen(points, views) >= 2])
        if sum(map(len, kept)) >= count:
            break
    xyz = np.concatenate(kept)[:count]
    if len(xyz) == 0:
        raise CaptureError(
            "there are no points, and no two views look at the same part of the space around the cameras"
        )
    color = np.mean([view.image.mean(axis=(0, 1)) for view in views], axis=0)
    return SparsePoints(xyz, np.tile(np.rint(color).astype(np.uint8), (len(xyz), 1)))


def _times_seen(points: np.ndarray, views: Sequence[View]) -> np.ndarray:
    """Count for every point the views that have it in front of them and inside the image. int64 [P]"""
    seen = np.zeros(len(points), np.int64)
    for view in views:
        seen += in_picture(points, view)
    return seen


def in_picture(points: np.ndarray, view: View) -> np.ndarray:
    """Tell which points a view has in front of it and inside its image, whatever may stand before them. bool [P]"""
    x, y, z = (points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).T
    # the image's edges as planes through the camera: no division, so points at z = 0 are harmless
    u = view.K[0, 0] * x + view.K[0, 2] * z
    v = view.K[1, 1] * y + view.K[1, 2] * z
    return (z > 0.0) & (u >= 0.0) & (u < view.width * z) & (v >= 0.0) & (v < view.height * z)
