"""Camera to screen: centres by the pinhole, covariances by its Jacobian (EWA splatting).

The Jacobian of (fx x/z + cx, fy y/z + cy) is
    J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]],
taken at a point whose x/z and y/z are clamped to a little more than the image (B1), since far outside the linearisation
blows up. Inside, J_02 = -fx x/z^2. Outside on the positive side, where x/z = limit, J_02 = -fx limit/z, so that
dJ_02/dx = 0 and dJ_02/dz = fx limit/z^2 = fx tx/z^3 with the clamped tx = limit z: half the inside form 2 fx tx/z^3.
Profile `inria` keeps the inside form for z; profile `paper` and gsplat use the true one.
"""

from __future__ import annotations

import numpy as np

from pop_ref._shapes import Float64
from pop_ref.constants import PAPER, Profile


def project_means(
    means_cam: Float64[np.ndarray, "N 3"],
    K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 2"]:
    """Project centres through the pinhole: `u = (fx x/z + cx, fy y/z + cy)`.

    Source: Kerbl et al. 2023 (3DGS), section 4.
    Departs: Inria replaces (cx, cy) by the image's centre and adds 1e-7 to the homogeneous w, which is left out here.

    Args:
        means_cam: centres, camera frame, z > 0, world units.
        K: intrinsics, px.
        width: px.
        height: px.
        profile: which principal point is used.

    Returns:
        Screen centres, px, pixel centres at +0.5.

    Example:
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]])
        >>> project_means(np.array([[1.0, 0.5, 4.0]]), K, 8, 4)
        array([[6., 3.]])
    """
    fx, fy, cx, cy = _intrinsics(K, width, height, profile)
    means2d = np.zeros((len(means_cam), 2))
    for i, (x, y, z) in enumerate(means_cam.tolist()):
        means2d[i] = fx * x / z + cx, fy * y / z + cy
    return means2d


def project_means_vjp(
    means_cam: Float64[np.ndarray, "N 3"],
    K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
    v_means2d: Float64[np.ndarray, "N 2"],
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 3"]:
    """Pull a cotangent of screen centres back: `v_p = J^T v_u` with the unclamped Jacobian.

    Source: transpose of `project_means`.
    Departs: nothing.

    Args:
        means_cam: centres, camera frame, z > 0, world units.
        K: intrinsics, px.
        width: px.
        height: px.
        v_means2d: cotangent of the screen centres.
        profile: which principal point is used.

    Returns:
        Cotangent of `means_cam`.

    Example:
        >>> project_means_vjp(np.array([[1.0, 2.0, 2.0]]), np.eye(3), 1, 1, np.array([[4.0, 8.0]]))
        array([[ 2.,  4., -5.]])
    """
    fx, fy, _, _ = _intrinsics(K, width, height, profile)
    v_means_cam = np.zeros(means_cam.shape)
    for i, (x, y, z) in enumerate(means_cam.tolist()):
        v_x, v_y = v_means2d[i].tolist()
        v_means_cam[i] = fx / z * v_x, fy / z * v_y, -(fx * x * v_x + fy * y * v_y) / (z * z)
    return v_means_cam


def projection_jacobians(
    means_cam: Float64[np.ndarray, "N 3"],
    K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 2 3"]:
    """Linearise the pinhole at each centre, clamped to the frustum.

    `J = [[fx/z, 0, -fx tx/z^2], [0, fy/z, -fy ty/z^2]]`,
    `tx = z clamp(x/z, -(cx/fx + m), (W - cx)/fx + m)` with `m = frustum_margin W/(2 fx)`; ty likewise (B1).

    Source: Zwicker et al. 2001 (EWA), eq. 29; Kerbl et al. 2023 (3DGS), eq. 5; the clamp from the code bases.
    Departs: the papers do not clamp (B1); Inria clamps about the image's centre.

    Args:
        means_cam: centres, camera frame, z > 0, world units.
        K: intrinsics, px.
        width: px.
        height: px.
        profile: the clamp's margin and which principal point is used.

    Returns:
        Jacobians, px per world unit.

    Example:
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 2.0], [0.0, 0.0, 1.0]])
        >>> projection_jacobians(np.array([[1.0, 0.5, 4.0]]), K, 8, 4)[0]
        array([[ 2.  ,  0.  , -0.5 ],
               [ 0.  ,  2.  , -0.25]])
    """
    fx, fy, _, _ = _intrinsics(K, width, height, profile)
    limits_x, limits_y = _frustum_limits(K, width, height, profile)
    jacobians = np.zeros((len(means_cam), 2, 3))
    for i, (x, y, z) in enumerate(means_cam.tolist()):
        tx = z * min(max(x / z, limits_x[0]), limits_x[1])
        ty = z * min(max(y / z, limits_y[0]), limits_y[1])
        jacobians[i] = [[fx / z, 0.0, -fx * tx / (z * z)], [0.0, fy / z, -fy * ty / (z * z)]]
    return jacobians


def projection_jacobians_vjp(
    means_cam: Float64[np.ndarray, "N 3"],
    K: Float64[np.ndarray, "3 3"],
    width: int,
    height: int,
    v_jacobians: Float64[np.ndarray, "N 2 3"],
    profile: Profile = PAPER,
) -> Float64[np.ndarray, "N 3"]:
    """Pull a cotangent of Jacobians back to the centres; see the module's text for the clamp (B1).

    At exactly the limit the derivative from inside is used.

    Source: transpose of `projection_jacobians`; gsplat v1.5 (`paper`), diff-gaussian-rasterization (`inria`).
    Departs: in `inria` the z derivative of a clamped entry keeps its unclamped form, as that code does (B1).

    Args:
        means_cam: centres, camera frame, z > 0, world units.
        K: intrinsics, px.
        width: px.
        height: px.
        v_jacobians: cotangent of the Jacobians.
        profile: the clamp and its gradient.

    Returns:
        Cotangent of `means_cam`.

    Example:
        >>> v_J = np.array([[[0.0, 0.0, 8.0], [0.0, 0.0, 4.0]]])
        >>> projection_jacobians_vjp(np.array([[0.5, 0.0, 2.0]]), np.eye(3), 4, 4, v_J)
        array([[-2., -1.,  1.]])
    """
    fx, fy, _, _ = _intrinsics(K, width, height, profile)
    limits_x, limits_y = _frustum_limits(K, width, height, profile)
    v_means_cam = np.zeros(means_cam.shape)
    for i, (x, y, z) in enumerate(means_cam.tolist()):
        (v_xx, _, v_xz), (_, v_yy, v_yz) = v_jacobians[i].tolist()
        v_x, v_z_x = _offset_vjp(x, z, fx, limits_x, v_xz, profile)
        v_y, v_z_y = _offset_vjp(y, z, fy, limits_y, v_yz, profile)
        v_means_cam[i] = v_x, v_y, v_z_x + v_z_y - (fx * v_xx + fy * v_yy) / (z * z)
    return v_means_cam


def project_covars(
    covars_cam: Float64[np.ndarray, "N 3 3"], jacobians: Float64[np.ndarray, "N 2 3"]
) -> Float64[np.ndarray, "N 2 2"]:
    """Project covariances to the screen: `Sigma2d = J Sigma_cam J^T`.

    Source: Kerbl et al. 2023 (3DGS), eq. 5.
    Departs: nothing; the low-pass is a stage of its own (`footprint.low_pass`).

    Args:
        covars_cam: covariances, camera frame, world units squared.
        jacobians: px per world unit.

    Returns:
        Screen covariances, px^2.

    Example:
        >>> J = np.array([[[2.0, 0.0, -0.5], [0.0, 2.0, 0.0]]])
        >>> project_covars(np.eye(3)[None], J)[0]
        array([[4.25, 0.  ],
               [0.  , 4.  ]])
    """
    covars2d = np.zeros((len(covars_cam), 2, 2))
    for i in range(len(covars_cam)):
        covars2d[i] = jacobians[i] @ covars_cam[i] @ jacobians[i].T
    return covars2d


def project_covars_vjp(
    covars_cam: Float64[np.ndarray, "N 3 3"],
    jacobians: Float64[np.ndarray, "N 2 3"],
    v_covars2d: Float64[np.ndarray, "N 2 2"],
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, "N 2 3"]]:
    """Pull a cotangent of screen covariances back.

    With V = v_Sigma2d: `v_Sigma_cam = J^T V J`, `v_J = V J Sigma_cam^T + V^T J Sigma_cam`.

    Source: transpose of `project_covars`.
    Departs: nothing.

    Args:
        covars_cam: covariances, camera frame, world units squared.
        jacobians: px per world unit.
        v_covars2d: cotangent of the screen covariances, symmetric or not.

    Returns:
        Cotangents of `covars_cam` and `jacobians`.

    Example:
        >>> J = np.array([[[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
        >>> v_covars_cam, v_J = project_covars_vjp(np.eye(3)[None], J, np.eye(2)[None])
        >>> v_J[0]
        array([[4., 0., 0.],
               [0., 4., 0.]])
    """
    v_covars_cam = np.zeros(covars_cam.shape)
    v_jacobians = np.zeros(jacobians.shape)
    for i in range(len(covars_cam)):
        J, Sigma, V = jacobians[i], covars_cam[i], v_covars2d[i]
        v_covars_cam[i] = J.T @ V @ J
        v_jacobians[i] = V @ J @ Sigma.T + V.T @ J @ Sigma
    return v_covars_cam, v_jacobians


def _intrinsics(
    K: Float64[np.ndarray, "3 3"], width: int, height: int, profile: Profile
) -> tuple[float, float, float, float]:
    if profile.principal_point == "centred":
        return float(K[0, 0]), float(K[1, 1]), width / 2.0, height / 2.0
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _frustum_limits(
    K: Float64[np.ndarray, "3 3"], width: int, height: int, profile: Profile
) -> tuple[tuple[float, float], tuple[float, float]]:
    fx, fy, cx, cy = _intrinsics(K, width, height, profile)
    margin_x = profile.frustum_margin * 0.5 * width / fx
    margin_y = profile.frustum_margin * 0.5 * height / fy
    limits_x = -(cx / fx + margin_x), (width - cx) / fx + margin_x
    limits_y = -(cy / fy + margin_y), (height - cy) / fy + margin_y
    return limits_x, limits_y


def _offset_vjp(
    x: float, z: float, fx: float, limits: tuple[float, float], v_offset: float, profile: Profile
) -> tuple[float, float]:
    # the transpose of (x, z) -> -fx tx / z^2, one axis of the Jacobian's last column
    tx = z * min(max(x / z, limits[0]), limits[1])
    if limits[0] <= x / z <= limits[1]:
        return -fx / (z * z) * v_offset, 2.0 * fx * tx / (z * z * z) * v_offset
    if profile.clamp_gradient == "inria":
        return 0.0, 2.0 * fx * tx / (z * z * z) * v_offset
    return 0.0, fx * tx / (z * z * z) * v_offset
