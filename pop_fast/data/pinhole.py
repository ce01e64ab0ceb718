"""Cameras without distortion, which need no COLMAP: a capture of pinholes loads where pycolmap is not installed."""

from __future__ import annotations

import signal
import sys
import threading
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_fast.errors import CaptureError

__all__ = ["PINHOLES", "PinholeCamera", "make_camera", "require_colmap"]

# COLMAP's name of a model: its number there, and where fx, fy, cx and cy stand among its parameters
PINHOLES: Final = {"SIMPLE_PINHOLE": (0, (0, 0, 1, 2)), "PINHOLE": (1, (0, 1, 2, 3))}


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """What is used of a `pycolmap.Camera`, under the same names.

    Attributes:
        camera_id: its number in a model.
        model_name: one of `PINHOLES`.
        width, height: px.
        params: focal lengths and principal point, px, as COLMAP orders them. float64 [3 | 4]
    """

    camera_id: int
    model_name: str
    width: int
    height: int
    params: np.ndarray

    def _param(self, which: int) -> float:
        return float(self.params[PINHOLES[self.model_name][1][which]])

    @property
    def focal_length_x(self) -> float:
        """Focal length along x, px."""
        return self._param(0)

    @property
    def focal_length_y(self) -> float:
        """Focal length along y, px."""
        return self._param(1)

    @property
    def principal_point_x(self) -> float:
        """Principal point, px from the left edge."""
        return self._param(2)

    @property
    def principal_point_y(self) -> float:
        """Principal point, px from the upper edge."""
        return self._param(3)

    def mean_focal_length(self) -> float:
        """Return the mean of both focal lengths, px."""
        return 0.5 * (self.focal_length_x + self.focal_length_y)

    def focal_length_idxs(self) -> list[int]:
        """Tell which parameters are focal lengths."""
        return sorted(set(PINHOLES[self.model_name][1][:2]))

    def img_from_cam(self, points: np.ndarray) -> np.ndarray:
        """Project points in front of the camera: x = f X / Z + c. float64 [P, 3] -> float64 [P, 2]"""
        focal = np.array([self.focal_length_x, self.focal_length_y])
        return focal * (points[:, :2] / points[:, 2:]) + np.array([self.principal_point_x, self.principal_point_y])


def require_colmap() -> Any:
    """Import pycolmap, which knows the other camera models, and finds cameras.

    Raises:
        CaptureError: it is not installed.
    """
    first = "pycolmap" not in sys.modules
    try:
        import pycolmap

        if first and threading.current_thread() is threading.main_thread():
            # its log takes SIGTERM to print where the program was
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    except ImportError as error:
        raise CaptureError(
            f"pycolmap cannot be imported ({error}), which finds cameras and reads all with distortion; pip install "
            f"pycolmap, or use photographs of known cameras of the models {', '.join(PINHOLES)}"
        ) from error
    return pycolmap


def make_camera(camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """Build a camera whose fields are not judged yet: a `PinholeCamera`, or a `pycolmap.Camera` of any other model.

    Raises:
        CaptureError: the model needs pycolmap, which is not installed.
    """
    if model in PINHOLES:
        return PinholeCamera(camera_id, model, width, height, np.array(params, dtype=np.float64))
    return require_colmap().Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
