"""What one browser shows: a camera, a size, a mode and what is left out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
import torch

from pop_fast.train.views import ViewTensors

Mode = Literal["colour", "dominant", "opacity", "depth"]
MODES: Final[tuple[Mode, ...]] = get_args(Mode)
# xmin, ymin, zmin, xmax, ymax, zmax
Box = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class ViewState:
    """A view that can be drawn.

    Attributes:
        viewmat: world -> camera, OpenCV. [4, 4]
        fov_y: angle from the upper to the lower edge, radians.
        width: px
        height: px
        mode: what is drawn: the render, dominant Gaussians, how opaque pixels are, or their depth.
        min_opacity: Gaussians of less are left out.
        crop: those with centres outside are left out; in the capture's own frame.
    """

    viewmat: np.ndarray
    fov_y: float
    width: int
    height: int
    mode: Mode = "colour"
    min_opacity: float = 0.0
    crop: Box | None = None

    @property
    def K(self) -> np.ndarray:
        """Intrinsics, px, with square pixels and the axis in the middle. [3, 3]"""
        return intrinsics(self.fov_y, self.width, self.height)

    def camera(self) -> ViewTensors:
        """Return the camera as renderers take it."""
        blank = torch.zeros((self.height, self.width, 3), dtype=torch.uint8)
        viewmat = torch.from_numpy(np.asarray(self.viewmat, np.float64)).float()[None]
        return ViewTensors("view", blank, None, viewmat, torch.from_numpy(self.K).float()[None])


def intrinsics(fov_y: float, width: int, height: int) -> np.ndarray:
    """Return the intrinsics of a camera with square pixels and its axis in the middle, px. [3, 3]"""
    focal = height / (2.0 * np.tan(fov_y / 2.0))
    return np.array([[focal, 0.0, width / 2.0], [0.0, focal, height / 2.0], [0.0, 0.0, 1.0]])


def field_of_view(K: np.ndarray, height: int) -> float:
    """Return the angle from the upper to the lower edge of a photograph, radians."""
    return float(2.0 * np.arctan2(height / 2.0, K[1, 1]))


def viewmat_of_pose(wxyz: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return world -> camera of a camera's rotation (camera -> world, unit quaternion) and place. [4, 4]"""
    w, x, y, z = np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ np.asarray(position, np.float64)
    return viewmat


def pose_of_viewmat(viewmat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a camera's rotation, camera -> world as a unit quaternion wxyz, and its place. [4], [3]"""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(viewmat[:3, :3].T).as_quat()
    return np.array([w, x, y, z]), -viewmat[:3, :3].T @ viewmat[:3, 3]
