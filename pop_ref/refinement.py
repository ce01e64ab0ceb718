"""Small corrections of cameras, learned with the scene: `viewmat' = [R(w) u; 0 1] viewmat`.

The correction is six numbers in the camera's own axes: a rotation vector w (its direction is the axis, its length the
angle) and a translation u. Rodrigues' formula, with K = [w]x (K x = w x x) and s = |w|^2, is

    R = I + a(s) K + b(s) K^2,      a = sin(sqrt s) / sqrt s,      b = (1 - cos(sqrt s)) / s

and as functions of s both are smooth at 0, where most corrections stay:

    da/ds = (sqrt s cos(sqrt s) - sin(sqrt s)) / (2 s^(3/2)),      db/ds = (a - 2 b) / (2 s)

which are differences of nearly equal numbers there, so below `_SMALL` their Taylor series are taken.
"""

from __future__ import annotations

import math

import numpy as np

from pop_ref._shapes import Float64

# rad^2: the first term that the series leave out is below 1e-17 of the first that they keep
_SMALL = 1e-2


def rotmat_from_vector(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Turn a rotation vector into a matrix: `R = I + a K + b K^2`.

    Source: Rodrigues 1840; Hartley and Zisserman 2004, section A4.3.2.
    Departs: gsplat's pose optimisation has six numbers of a matrix's columns, orthonormalised; near the identity both
        move alike.

    Args:
        vector: axis times angle, rad.

    Returns:
        The rotation.

    Example:
        >>> rotmat_from_vector(np.array([0.0, 0.0, np.pi / 2.0])).round(12) + 0.0
        array([[ 0., -1.,  0.],
               [ 1.,  0.,  0.],
               [ 0.,  0.,  1.]])
    """
    a, b, _, _ = _coefficients(float(vector @ vector))
    K = _cross(vector)
    return np.eye(3) + a * K + b * (K @ K)


def rotmat_from_vector_vjp(
    vector: Float64[np.ndarray, "3"], v_rotmat: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "3"]:
    """Pull a cotangent of the rotation back: through K, and through a and b by s = |w|^2.

    Source: transpose of `rotmat_from_vector`.
    Departs: nothing.

    Args:
        vector: axis times angle, rad.
        v_rotmat: cotangent of the rotation.

    Returns:
        Cotangent of the vector, 1/rad.

    Example:
        >>> v_rotmat = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
        >>> rotmat_from_vector_vjp(np.zeros(3), v_rotmat)
        array([0., 0., 2.])
    """
    a, b, a_slope, b_slope = _coefficients(float(vector @ vector))
    K = _cross(vector)
    v_K = a * v_rotmat + b * (v_rotmat @ K.T + K.T @ v_rotmat)
    v_s = a_slope * float(np.sum(v_rotmat * K)) + b_slope * float(np.sum(v_rotmat * (K @ K)))
    through_K = np.array([v_K[2, 1] - v_K[1, 2], v_K[0, 2] - v_K[2, 0], v_K[1, 0] - v_K[0, 1]])
    return through_K + 2.0 * v_s * vector


def refined_viewmat(
    viewmat: Float64[np.ndarray, "4 4"], correction: Float64[np.ndarray, "6"]
) -> Float64[np.ndarray, "4 4"]:
    """Correct a camera: `viewmat' = [R(w) u; 0 1] viewmat`, correction = (w, u).

    Source: gsplat's trainer (`pose_opt`).
    Departs: gsplat multiplies the camera-to-world matrix from the right, by the inverse of such a motion, and holds the
        rotation by six numbers (`rotmat_from_vector`).

    Args:
        viewmat: world -> camera, rigid.
        correction: rotation vector, rad, and translation, world units, in the camera's axes; zeros change nothing.

    Returns:
        World -> corrected camera, rigid.

    Example:
        >>> refined_viewmat(np.eye(4), np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.25]))[:3, 3]
        array([0.5 , 0.  , 0.25])
    """
    motion = np.eye(4)
    motion[:3, :3] = rotmat_from_vector(correction[:3])
    motion[:3, 3] = correction[3:]
    return motion @ viewmat


def refined_viewmat_vjp(
    viewmat: Float64[np.ndarray, "4 4"],
    correction: Float64[np.ndarray, "6"],
    v_refined: Float64[np.ndarray, "4 4"],
) -> tuple[Float64[np.ndarray, "4 4"], Float64[np.ndarray, "6"]]:
    """Pull a cotangent of the corrected camera back: `v_viewmat = M^T v'`, `v_M = v' viewmat^T`.

    Source: transpose of `refined_viewmat`.
    Departs: nothing; the last row of a view matrix is constant, so its cotangents are zero.

    Args:
        viewmat: world -> camera, rigid.
        correction: rotation vector and translation.
        v_refined: cotangent of the corrected view matrix, its last row zero.

    Returns:
        Cotangents of the view matrix, its last row zero, and of the correction.

    Example:
        >>> v_refined = np.zeros((4, 4))
        >>> v_refined[:3, 3] = [1.0, 2.0, 4.0]
        >>> refined_viewmat_vjp(np.eye(4), np.zeros(6), v_refined)[1]
        array([0., 0., 0., 1., 2., 4.])
    """
    rotmat = rotmat_from_vector(correction[:3])
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3] = rotmat.T @ v_refined[:3]
    v_motion = v_refined[:3] @ viewmat.T
    return v_viewmat, np.concatenate([rotmat_from_vector_vjp(correction[:3], v_motion[:, :3]), v_motion[:, 3]])


def without_common_motion(
    corrections: Float64[np.ndarray, "V 6"], viewmats: Float64[np.ndarray, "V 4 4"]
) -> Float64[np.ndarray, "V 6"]:
    """Take out of the corrections what moves all cameras alike: `c - A x`, x least squares of `A x = c`.

    A motion of the whole world by the small twist x = (w, u) is in camera i's axes `A_i x = (R w, t x R w + R u)`. When
    all cameras move so and the Gaussians follow, every image stays: nothing in the loss holds such a motion back, but
    held-out cameras, which have no correction, do not follow it.

    Source: the adjoint of a rigid motion, Murray, Li and Sastry 1994, section 2.4.2.
    Departs: gsplat lets the cameras drift. Exact to first order in the corrections, which are small.

    Args:
        corrections: rotation vectors and translations of the training cameras.
        viewmats: their world -> camera matrices before correction, rigid.

    Returns:
        The corrections less the common motion.

    Example:
        >>> viewmats = np.stack([np.eye(4), np.eye(4)])
        >>> together = np.tile([0.0, 0.0, 0.25, 0.5, 0.0, 0.0], (2, 1))
        >>> np.abs(without_common_motion(together, viewmats)).max() < 1e-15
        np.True_
    """
    A = np.zeros((6 * len(viewmats), 6))
    for i, viewmat in enumerate(viewmats):
        R, t = viewmat[:3, :3], viewmat[:3, 3]
        A[6 * i : 6 * i + 3, :3] = R
        A[6 * i + 3 : 6 * i + 6, :3] = _cross(t) @ R
        A[6 * i + 3 : 6 * i + 6, 3:] = R
    stacked = corrections.reshape(-1)
    return (stacked - A @ np.linalg.lstsq(A, stacked, rcond=None)[0]).reshape(-1, 6)


def _cross(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    x, y, z = (float(entry) for entry in vector)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _coefficients(s: float) -> tuple[float, float, float, float]:
    """Return a, b and their derivatives by s."""
    if s < _SMALL:
        a = sum((-s) ** k / math.factorial(2 * k + 1) for k in range(8))
        b = sum((-s) ** k / math.factorial(2 * k + 2) for k in range(8))
        a_slope = -sum((k + 1) * (-s) ** k / math.factorial(2 * k + 3) for k in range(8))
        b_slope = -sum((k + 1) * (-s) ** k / math.factorial(2 * k + 4) for k in range(8))
        return a, b, a_slope, b_slope
    angle = math.sqrt(s)
    a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / s
    return a, b, (math.cos(angle) - a) / (2.0 * s), (a - 2.0 * b) / (2.0 * s)
