"""Cameras as files describe them: numbers by field, poses of either handedness, rotations, pinholes, Brown's lenses.

Cameras without distortion need no COLMAP: a capture of pinholes loads where pycolmap is not installed.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from pop_fast.errors import CaptureError
from pop_fast.io.ply import FARTHEST

# files hold single precision or a few digits; anything further off is another kind of matrix
_TOLERANCE = 1e-3
# a quaternion that is shorter is no direction any more, only what is left of rounding or of a corrupt file
_SHORTEST = 1e-6


def affine(linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the matrix of x -> linear x + shift. float64 [4, 4]"""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the rigid matrix nearest to `matrix` [4, 4], R = U V^T of its singular value decomposition. float64 [4, 4]

    Raises:
        ValueError: NaN, Inf or an absurd distance, a last row other than 0 0 0 1, a scale, shear or reflection. The
            message continues "<matrix> ...".
    """
    if not np.all(np.isfinite(matrix)):
        row, column = (int(i) for i in np.argwhere(~np.isfinite(matrix))[0])
        raise ValueError(f"[{row}][{column}] is {matrix[row, column]}; every entry must be finite")
    if np.abs(matrix).max() > FARTHEST:
        row, column = (int(i) for i in np.argwhere(np.abs(matrix) > FARTHEST)[0])
        raise ValueError(f"[{row}][{column}] is {matrix[row, column]}; it must be within {FARTHEST:.0e}")
    if np.abs(matrix[3] - np.array([0.0, 0.0, 0.0, 1.0])).max() > _TOLERANCE:
        raise ValueError(f"has the last row {matrix[3].tolist()}; it must be [0, 0, 0, 1]")
    linear = matrix[:3, :3]
    U, singular, Vt = np.linalg.svd(linear)
    if np.abs(singular - 1.0).max() > _TOLERANCE:
        raise ValueError(
            f"is not rigid: it scales by {singular.max():.4g} and {singular.min():.4g}; its 3x3 part must be a rotation"
        )
    if np.linalg.det(linear) < 0.0:
        raise ValueError("is not rigid: it mirrors (determinant -1); its 3x3 part must be a rotation")
    return affine(U @ Vt, matrix[:3, 3])


def rigid_from_quat(quat: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build [R t; 0 1] from a quaternion wxyz of any norm, R that of quat / |quat|. float64 [4, 4]

    Raises:
        ValueError: NaN or Inf, a quaternion of norm zero, or an absurd distance.
    """
    if not np.all(np.isfinite(quat)) or np.abs(quat).max() < _SHORTEST:
        raise ValueError(f"its quaternion QW QX QY QZ is {quat.tolist()}; it must be finite and not zero")
    if not np.all(np.abs(translation) <= FARTHEST):
        raise ValueError(
            f"its translation TX TY TZ is {translation.tolist()}; it must be finite and within {FARTHEST:.0e}"
        )
    # divided by its largest entry first, so that no square overflows
    unit = quat / np.abs(quat).max()
    unit = unit / np.linalg.norm(unit)
    return affine(np.array(_rotation(*unit.tolist())), translation)


def _rotation(w: float, x: float, y: float, z: float) -> list[list[float]]:
    """Turn a quaternion into a matrix, to the bits of scipy's `Rotation`, which takes longer to import than to use.

    What a capture's poses come to is part of its fingerprint in checkpoints.
    """
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    x2, y2, z2, w2 = x * x, y * y, z * z, w * w
    return [
        [x2 - y2 - z2 + w2, 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), -x2 + y2 - z2 + w2, 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), -x2 - y2 + z2 + w2],
    ]


# px; more than any photograph has, and less than what a corrupt number would ask for
WIDEST: Final = 1_000_000
_OPENGL: Final = np.array([1.0, -1.0, -1.0])


class Numbers:
    """A function that gives fields of a file by name, and refuses those that are no finite numbers.

    `where` is file and place in it, for errors; values may be texts of numbers where `texts` is set, as in XML and CSV.
    """

    def __init__(self, where: str, fields: Mapping[str, Any], texts: bool = False) -> None:
        self.where, self.fields, self._texts = where, fields, texts

    def __call__(self, name: str, default: float | None = None) -> float:
        """Return a field, or its default; a CaptureError says that there is neither, or no finite number."""
        value = self.fields.get(name, default)
        refused = bool if self._texts else bool | str
        try:
            number = math.nan if isinstance(value, refused) or value is None else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number):
            raise CaptureError(f"{self.where}: {name} is {shortened(value)}; it must be a finite number")
        return number


def shortened(value: object) -> str:
    """Show a value of a file in an error, cut to a line."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def check_size(where: str, width: float, height: float) -> tuple[int, int]:
    """Return a photograph's size as whole numbers; a CaptureError refuses one that no photograph has."""
    if not (1 <= width <= WIDEST and 1 <= height <= WIDEST):
        raise CaptureError(f"{where}: size is {width:g} x {height:g}; both must be at least 1 and at most {WIDEST}")
    return int(width), int(height)


def viewmat_from_pose(where: str, pose: np.ndarray, opengl: bool) -> np.ndarray:
    """Invert a rigid camera-to-world matrix [4, 4]; a CaptureError of one that is not rigid begins with `where`.

    Args:
        where: file and field.
        pose: the matrix.
        opengl: the camera's axes are OpenGL's (+y up, -z forward) in the place of OpenCV's.

    Returns:
        World -> camera, OpenCV. float64 [4, 4]
    """
    try:
        pose = nearest_rigid(pose)
    except ValueError as error:
        raise CaptureError(f"{where} {error}") from error
    rotation = pose[:3, :3] * (_OPENGL if opengl else 1.0)
    return affine(rotation.T, -rotation.T @ pose[:3, 3])


def brown_lens(
    radial: Sequence[float], tangential: Sequence[float]
) -> tuple[Literal["PINHOLE", "OPENCV", "FULL_OPENCV"], list[float]]:
    """Choose COLMAP's smallest model for Brown's distortion, and its parameters after the pinhole's four.

    Radial terms are k1, k2, k3; tangential ones p1, p2 as OpenCV has them: x gains 2 p1 x y + p2 (r^2 + 2 x^2).
    """
    k1, k2, k3 = radial
    if k3:
        return "FULL_OPENCV", [k1, k2, *tangential, k3, 0.0, 0.0, 0.0]
    if k1 or k2 or any(tangential):
        return "OPENCV", [k1, k2, *tangential]
    return "PINHOLE", []


# COLMAP's name of a model: its number there, and where fx, fy, cx and cy stand among its parameters
PINHOLES: Final = {"SIMPLE_PINHOLE": (0, (0, 0, 1, 2)), "PINHOLE": (1, (0, 1, 2, 3))}


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """What is used of a `pycolmap.Camera`, under the same names: sizes, focal lengths and principal point in px."""

    camera_id: int
    model_name: str
    width: int
    height: int
    params: np.ndarray  # as COLMAP orders them

    def _param(self, which: int) -> float:
        return float(self.params[PINHOLES[self.model_name][1][which]])

    @property
    def focal_length_x(self) -> float:
        return self._param(0)

    @property
    def focal_length_y(self) -> float:
        return self._param(1)

    @property
    def principal_point_x(self) -> float:
        return self._param(2)

    @property
    def principal_point_y(self) -> float:
        return self._param(3)

    def mean_focal_length(self) -> float:
        return 0.5 * (self.focal_length_x + self.focal_length_y)

    def focal_length_idxs(self) -> list[int]:
        return sorted(set(PINHOLES[self.model_name][1][:2]))

    def img_from_cam(self, points: np.ndarray) -> np.ndarray:
        """Project points in front of the camera: x = f X / Z + c. float64 [P, 3] -> float64 [P, 2]"""
        focal = np.array([self.focal_length_x, self.focal_length_y])
        return focal * (points[:, :2] / points[:, 2:]) + np.array([self.principal_point_x, self.principal_point_y])


def require_colmap() -> Any:
    """Import pycolmap, which knows the other camera models, and finds cameras; a CaptureError where it is absent."""
    first = "pycolmap" not in sys.modules
    try:
        import pycolmap

        if first and threading.current_thread() is threading.main_thread():
            # its log takes SIGTERM to print where the program was
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    except ImportError as error:
        raise CaptureError(
            f"pycolmap, which finds cameras and reads those with distortion, cannot be imported ({error}); pip install "
            f"pycolmap, or use photographs of known cameras of the models {', '.join(PINHOLES)}"
        ) from error
    return pycolmap


def make_camera(camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """Build a camera whose fields are not judged yet: a `PinholeCamera`, or a `pycolmap.Camera` of any other model."""
    if model in PINHOLES:
        return PinholeCamera(camera_id, model, width, height, np.array(params, dtype=np.float64))
    return require_colmap().Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
