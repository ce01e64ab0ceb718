"""Tell a rotation from what only looks like one."""

from __future__ import annotations

import numpy as np

__all__ = ["nearest_rigid"]

# files hold single precision or a few digits; anything further off is another kind of matrix
_TOLERANCE = 1e-3


def nearest_rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the rigid matrix nearest to `matrix`: R = U V^T of its singular value decomposition.

    Args:
        matrix: float64 [4, 4]; rigid but for the rounding of a file.

    Raises:
        ValueError: NaN or Inf, a last row other than 0 0 0 1, a scale, shear or reflection. The message continues
            "<matrix> ...".
    """
    if not np.all(np.isfinite(matrix)):
        row, column = (int(i) for i in np.argwhere(~np.isfinite(matrix))[0])
        raise ValueError(f"[{row}][{column}] is {matrix[row, column]}; every entry must be finite")
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
