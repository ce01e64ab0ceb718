"""Cameras as files describe them: numbers by field, poses of either handedness, rotations, models.

Cameras of a model whose `distort` the table of models has need no COLMAP: a capture of pinholes loads where pycolmap is
not installed.
"""

from __future__ import annotations

import math
import signal
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from pop_fast.data.camera_models import CAMERA_MODELS, CameraModel, fields_of, known_model, models_of
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


def choose_model(program: str, kind: str, number: Numbers, called: str) -> tuple[str, list[float]]:
    """Choose the camera model of a list's camera, the first of `CAMERA_MODELS` that has all terms which it gives.

    Args:
        program: whose list it is, as `CameraModel.fields` has it.
        kind: what the list calls the model.
        number: gives its fields.
        called: what an error calls the model.

    Returns:
        The model's name, and its terms in order.

    Raises:
        CaptureError: no model of that kind has such a term, or no photograph of that kind can be used.
    """
    given = {name: value for name in fields_of(program) if (value := number(name, 0.0))}
    models, foreign = models_of(program), dict(given)
    for model in models[kind]:
        if model.refusal is not None:
            raise CaptureError(f"{number.where}: {called} is {model.refusal}")
        names = model.fields[program, kind]
        left = {name: value for name, value in given.items() if name not in names.values()}
        if not left:
            return model.name, [given.get(names.get(term, ""), 0.0) for term in model.terms]
        foreign = min(foreign, left, key=len)
    name = next(iter(foreign))
    others = [other for other, known in models.items() if any(name in m.fields[program, other].values() for m in known)]
    fix = f", or use a model that has it: {', '.join(others)}" if others else ""
    raise CaptureError(
        f"{number.where}: {name} is {foreign[name]:g}, but {called} has no such term; remove {', '.join(foreign)} if "
        f"the photographs are undistorted, else undistort them there{fix}"
    )


@dataclass(frozen=True, eq=False)
class ModelCamera:
    """A camera of a model with `distort`: what is used of a `pycolmap.Camera`, under the same names, sizes in px."""

    camera_id: int
    model: CameraModel
    width: int
    height: int
    params: np.ndarray  # as the model orders them

    @property
    def model_name(self) -> str:
        return self.model.name

    def _param(self, *names: str) -> float:
        return float(next(self.params[i] for i, name in enumerate(self.model.params) if name in names))

    @property
    def focal_length_x(self) -> float:
        return self._param("f", "fx")

    @property
    def focal_length_y(self) -> float:
        return self._param("f", "fy")

    @property
    def principal_point_x(self) -> float:
        return self._param("cx")

    @property
    def principal_point_y(self) -> float:
        return self._param("cy")

    def mean_focal_length(self) -> float:
        return 0.5 * (self.focal_length_x + self.focal_length_y)

    def focal_length_idxs(self) -> list[int]:
        return [i for i, name in enumerate(self.model.params) if name in ("f", "fx", "fy")]

    def img_from_cam(self, points: np.ndarray) -> np.ndarray:
        """Project points in front of the camera. float64 [P, 3] -> float64 [P, 2]"""
        assert self.model.distort is not None
        x, y = (points[:, :2] / points[:, 2:]).T
        bent = np.stack(self.model.distort(x, y, *(self._param(term) for term in self.model.terms)), axis=1)
        focal = np.array([self.focal_length_x, self.focal_length_y])
        return focal * bent + np.array([self.principal_point_x, self.principal_point_y])


def require_colmap() -> Any:
    """Import pycolmap, which knows the other camera models, and finds cameras; a CaptureError where it is absent."""
    first = "pycolmap" not in sys.modules
    try:
        import pycolmap

        if first and threading.current_thread() is threading.main_thread():
            # its log takes SIGTERM to print where the program was
            signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))
    except ImportError as error:
        own = [name for name, model in CAMERA_MODELS.usable() if model.distort is not None]
        raise CaptureError(
            f"pycolmap, which finds cameras and reads those with distortion, cannot be imported ({error}); pip install "
            f"pycolmap, or use photographs of known cameras of the models {', '.join(own)}"
        ) from error
    return pycolmap


def make_camera(camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """Build a camera whose fields are not judged yet: a `ModelCamera`, or a `pycolmap.Camera` of COLMAP's other models.

    Raises:
        CaptureError: the model has another number of parameters, or is COLMAP's where pycolmap is not installed.
    """
    known = known_model(model)
    if known is not None and len(params) != len(known.params):
        raise CaptureError(f"camera {camera_id} has {len(params)} parameters; {model} has {', '.join(known.params)}")
    if known is not None and known.distort is not None:
        return ModelCamera(camera_id, known, width, height, np.array(params, dtype=np.float64))
    return require_colmap().Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
