"""World covariances from rotations and standard deviations: `Sigma = R diag(s)^2 R^T`.

With M = R diag(s), Sigma = M M^T, which is symmetric and positive semi-definite whatever the parameters. Its
differential dSigma = dM M^T + M dM^T gives the transpose v_M = (v_Sigma + v_Sigma^T) M.
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.activations import unit_quats_from_quats, unit_quats_from_quats_vjp


def rotmats_from_quats(quats: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Make the rotation matrices of quaternions, which are normalised first.

    With u = (w, x, y, z) = q / |q|:
    `R = [[1-2(yy+zz), 2(xy-wz), 2(xz+wy)], [2(xy+wz), 1-2(xx+zz), 2(yz-wx)], [2(xz-wy), 2(yz+wx), 1-2(xx+yy)]]`.

    Source: Kerbl et al. 2023 (3DGS), appendix A.
    Departs: nothing; Inria normalises outside its kernel, gsplat inside, with the same gradient.

    Args:
        quats: wxyz, any norm > 0; q and -q give the same bits.

    Returns:
        Rotation matrices, Gaussian -> world.

    Example:
        >>> rotmats_from_quats(np.array([[2.0, 0.0, 0.0, 2.0]])).round(12)[0, 0]
        array([ 0., -1.,  0.])
    """
    rotmats = np.zeros((len(quats), 3, 3))
    for i, (w, x, y, z) in enumerate(unit_quats_from_quats(quats).tolist()):
        rotmats[i] = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    return rotmats


def rotmats_from_quats_vjp(
    quats: Float64[np.ndarray, "N 4"], v_rotmats: Float64[np.ndarray, "N 3 3"]
) -> Float64[np.ndarray, "N 4"]:
    """Pull a cotangent of rotation matrices back to quaternions of any norm.

    The entries of R are quadratic in u, so `v_u_k = sum_ij v_R_ij dR_ij/du_k` is written out; then the normalisation's
    transpose takes v_u to v_q.

    Source: transpose of `rotmats_from_quats`.
    Departs: nothing.

    Args:
        quats: wxyz, any norm > 0.
        v_rotmats: cotangent of the rotation matrices.

    Returns:
        Cotangent of `quats`, orthogonal to them.

    Example:
        >>> v_R = np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]])
        >>> rotmats_from_quats_vjp(np.array([[1.0, 0.0, 0.0, 0.0]]), v_R)
        array([[0., 0., 0., 4.]])
    """
    v_units = np.zeros((len(quats), 4))
    for i, (w, x, y, z) in enumerate(unit_quats_from_quats(quats).tolist()):
        (v00, v01, v02), (v10, v11, v12), (v20, v21, v22) = v_rotmats[i].tolist()
        v_units[i] = [
            2.0 * (x * (v21 - v12) + y * (v02 - v20) + z * (v10 - v01)),
            2.0 * (w * (v21 - v12) + y * (v01 + v10) + z * (v02 + v20) - 2.0 * x * (v11 + v22)),
            2.0 * (w * (v02 - v20) + x * (v01 + v10) + z * (v12 + v21) - 2.0 * y * (v00 + v22)),
            2.0 * (w * (v10 - v01) + x * (v02 + v20) + y * (v12 + v21) - 2.0 * z * (v00 + v11)),
        ]
    return unit_quats_from_quats_vjp(quats, v_units)


def covars_from_quats_scales(
    quats: Float64[np.ndarray, "N 4"], scales: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3 3"]:
    """Make world covariances: `Sigma = M M^T` with `M = R diag(s)`.

    Source: Kerbl et al. 2023 (3DGS), eq. 6.
    Departs: nothing.

    Args:
        quats: wxyz, any norm > 0.
        scales: standard deviations, world units, >= 0.

    Returns:
        Covariances, world frame, world units squared; exactly symmetric.

    Example:
        >>> covars_from_quats_scales(np.array([[1.0, 0.0, 0.0, 0.0]]), np.array([[1.0, 2.0, 4.0]]))[0]
        array([[ 1.,  0.,  0.],
               [ 0.,  4.,  0.],
               [ 0.,  0., 16.]])
    """
    rotmats = rotmats_from_quats(quats)
    covars = np.zeros((len(quats), 3, 3))
    for i in range(len(quats)):
        M = rotmats[i] * scales[i]
        covars[i] = M @ M.T
    return covars


def covars_from_quats_scales_vjp(
    quats: Float64[np.ndarray, "N 4"], scales: Float64[np.ndarray, "N 3"], v_covars: Float64[np.ndarray, "N 3 3"]
) -> tuple[Float64[np.ndarray, "N 4"], Float64[np.ndarray, "N 3"]]:
    """Pull a cotangent of covariances back to quaternions and scales.

    `v_M = (v_Sigma + v_Sigma^T) M`, `v_R = v_M diag(s)`, `v_s_j = sum_i R_ij v_M_ij`.

    Source: transpose of `covars_from_quats_scales`.
    Departs: nothing.

    Args:
        quats: wxyz, any norm > 0.
        scales: standard deviations, world units, >= 0.
        v_covars: cotangent of the covariances, symmetric or not.

    Returns:
        Cotangents of `quats` and `scales`.

    Example:
        >>> v_q, v_s = covars_from_quats_scales_vjp(np.eye(4)[:1], np.array([[1.0, 2.0, 4.0]]), np.eye(3)[None])
        >>> v_s
        array([[2., 4., 8.]])
    """
    rotmats = rotmats_from_quats(quats)
    v_rotmats = np.zeros((len(quats), 3, 3))
    v_scales = np.zeros((len(quats), 3))
    for i in range(len(quats)):
        R, s = rotmats[i], scales[i]
        v_M = (v_covars[i] + v_covars[i].T) @ (R * s)
        v_rotmats[i] = v_M * s
        v_scales[i] = np.sum(R * v_M, axis=0)
    return rotmats_from_quats_vjp(quats, v_rotmats), v_scales
