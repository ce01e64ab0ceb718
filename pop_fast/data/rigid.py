"""Tell a rotation from what only looks like one."""

from __future__ import annotations

import math

import numpy as np

from pop_fast.io.points import FARTHEST

__all__ = ["nearest_rigid", "rigid_from_quat"]

# files hold single precision or a few digits; anything further off is another kind of matrix
_TOLERANCE = 1e-3
# a quaternion that is shorter is no direction any more, only what is left of rounding or of a corrupt file
_SHORTEST = 1e-6


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the rigid matrix nearest to `matrix`: R = U V^T of its singular value decomposition.

    Args:
        matrix: float64 [4, 4]; rigid but for the rounding of a file.

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
    rigid = np.eye(4)
    rigid[:3, :3] = U @ Vt
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def rigid_from_quat(quat: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Build [R t; 0 1] from a quaternion of any norm, R that of quat / |quat|. float64 [4, 4]

    Args:
        quat: wxyz. float64 [4]
        translation: float64 [3]

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
    rigid = np.eye(4)
    rigid[:3, :3] = _rotation(*unit.tolist())
    rigid[:3, 3] = translation
    return rigid


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
