"""What readers of camera files share: numbers by field, poses of either handedness, lenses by Brown's model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Literal

import numpy as np

from pop_fast.data.rigid import nearest_rigid
from pop_fast.errors import CaptureError

__all__ = ["Numbers", "brown_lens", "check_size", "shortened", "viewmat_from_pose"]

# px; more than any photograph has, and less than what a corrupt number would ask for
WIDEST: Final = 1_000_000
_OPENGL: Final = np.array([1.0, -1.0, -1.0])


class Numbers:
    """Look fields up as finite numbers, or say which is none.

    Args:
        where: file and place in it, for errors.
        fields: by name; values are numbers, or texts of numbers where `texts` allows these.
        texts: take texts, as in XML and CSV.
    """

    def __init__(self, where: str, fields: Mapping[str, Any], texts: bool = False) -> None:
        self.where, self.fields, self._texts = where, fields, texts

    def __call__(self, name: str, default: float | None = None) -> float:
        """Return a field.

        Raises:
            CaptureError: it is absent and has no default, or is no finite number.
        """
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
    """Return a photograph's size as whole numbers.

    Raises:
        CaptureError: it is none that a photograph has.
    """
    if not (1 <= width <= WIDEST and 1 <= height <= WIDEST):
        raise CaptureError(f"{where}: size is {width:g} x {height:g}; both must be at least 1 and at most {WIDEST}")
    return int(width), int(height)


def viewmat_from_pose(where: str, pose: np.ndarray, opengl: bool) -> np.ndarray:
    """Invert a camera-to-world matrix.

    Args:
        where: file and field, for errors.
        pose: rigid. float64 [4, 4]
        opengl: the camera's axes are OpenGL's (+y up, -z forward) in the place of OpenCV's.

    Returns:
        World -> camera, OpenCV. float64 [4, 4]

    Raises:
        CaptureError: the matrix is not rigid.
    """
    try:
        pose = nearest_rigid(pose)
    except ValueError as error:
        raise CaptureError(f"{where} {error}") from error
    rotation = pose[:3, :3] * (_OPENGL if opengl else 1.0)
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation.T
    viewmat[:3, 3] = -rotation.T @ pose[:3, 3]
    return viewmat


def brown_lens(
    radial: Sequence[float], tangential: Sequence[float]
) -> tuple[Literal["PINHOLE", "OPENCV", "FULL_OPENCV"], list[float]]:
    """Choose COLMAP's smallest model for Brown's distortion, and its parameters after the pinhole's four.

    Args:
        radial: k1, k2, k3.
        tangential: p1, p2 as OpenCV has them: x gains 2 p1 x y + p2 (r^2 + 2 x^2).
    """
    k1, k2, k3 = radial
    if k3:
        return "FULL_OPENCV", [k1, k2, *tangential, k3, 0.0, 0.0, 0.0]
    if k1 or k2 or any(tangential):
        return "OPENCV", [k1, k2, *tangential]
    return "PINHOLE", []
