"""World to camera: centres, view directions, points, covariances, and the near-plane cull.

The camera is rigid, `p_cam = R p + t` with R = viewmat[:3, :3] and t = viewmat[:3, 3], so its centre is -R^T t.
Gradients to `viewmat` treat its twelve upper entries as independent numbers; the last row gets zero.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from pop_ref._shapes import Bool, Float64
from pop_ref.constants import PAPER, Profile

# world units: the square of a smaller depth is 0 in float64
NEAREST: Final = 1e-150


def camera_center(viewmat: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "3"]:
    """Find the camera's centre in the world: `c = -R^T t`.

    Source: Hartley and Zisserman 2004, section 6.1.
    Departs: gsplat inverts the whole matrix; on a rigid one both agree, and so do their gradients along rigid motions.

    Args:
        viewmat: world -> camera, rigid.

    Returns:
        The centre, world units.

    Example:
        >>> viewmat = np.eye(4)
        >>> viewmat[:3, 3] = [0.0, 0.5, 4.0]
        >>> camera_center(viewmat) + 0.0
        array([ 0. , -0.5, -4. ])
    """
    return -viewmat[:3, :3].T @ viewmat[:3, 3]


def camera_center_vjp(
    viewmat: Float64[np.ndarray, "4 4"], v_center: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """Pull a cotangent of the camera's centre back: `v_R = -t v_c^T`, `v_t = -R v_c`.

    Source: transpose of `camera_center`.
    Departs: nothing.

    Args:
        viewmat: world -> camera, rigid.
        v_center: cotangent of the centre.

    Returns:
        Cotangent of `viewmat`, its last row zero.

    Example:
        >>> camera_center_vjp(np.eye(4), np.array([1.0, 2.0, 4.0]))[:3, 3]
        array([-1., -2., -4.])
    """
    v_viewmat = np.zeros((4, 4))
    v_viewmat[:3, :3] = -np.outer(viewmat[:3, 3], v_center)
    v_viewmat[:3, 3] = -viewmat[:3, :3] @ v_center
    return v_viewmat


def view_dirs(means: Float64[np.ndarray, "N 3"], viewmat: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "N 3"]:
    """Point from the camera's centre to each Gaussian: `d = mean - c`, not normalised.

    Source: Kerbl et al. 2023 (3DGS), section 4.
    Departs: nothing.

    Args:
        means: centres, world units.
        viewmat: world -> camera, rigid.

    Returns:
        Directions, world units.

    Example:
        >>> view_dirs(np.array([[1.0, 2.0, 4.0]]), np.eye(4)) + 0.0
        array([[1., 2., 4.]])
    """
    return means - camera_center(viewmat)


def view_dirs_vjp(
    means: Float64[np.ndarray, "N 3"], viewmat: Float64[np.ndarray, "4 4"], v_dirs: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "4 4"]]:
    """Pull a cotangent of view directions back: `v_means = v_d`, `v_c = -sum_i v_d_i`.

    Source: transpose of `view_dirs`.
    Departs: nothing.

    Args:
        means: centres, world units.
        viewmat: world -> camera, rigid.
        v_dirs: cotangent of the directions.

    Returns:
        Cotangents of `means` and `viewmat`.

    Example:
        >>> v_means, v_viewmat = view_dirs_vjp(np.zeros((1, 3)), np.eye(4), np.ones((1, 3)))
        >>> v_viewmat[:3, 3]
        array([1., 1., 1.])
    """
    return v_dirs.copy(), camera_center_vjp(viewmat, -np.sum(v_dirs, axis=0))


def means_cam_from_means(
    means: Float64[np.ndarray, "N 3"], viewmat: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "N 3"]:
    """Take centres into the camera frame: `p = R mean + t`; p_z is the depth.

    Source: Kerbl et al. 2023 (3DGS), section 4.
    Departs: nothing.

    Args:
        means: centres, world units.
        viewmat: world -> camera, rigid.

    Returns:
        Centres, camera frame (+x right, +y down, +z forward), world units.

    Example:
        >>> viewmat = np.eye(4)
        >>> viewmat[2, 3] = 4.0
        >>> means_cam_from_means(np.array([[1.0, 2.0, -0.5]]), viewmat)
        array([[1. , 2. , 3.5]])
    """
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    means_cam = np.zeros(means.shape)
    for i in range(len(means)):
        means_cam[i] = R @ means[i] + t
    return means_cam


def means_cam_from_means_vjp(
    means: Float64[np.ndarray, "N 3"], viewmat: Float64[np.ndarray, "4 4"], v_means_cam: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "4 4"]]:
    """Pull a cotangent of camera-frame centres back: `v_mean = R^T v_p`, `v_R = sum v_p mean^T`, `v_t = sum v_p`.

    Source: transpose of `means_cam_from_means`.
    Departs: nothing.

    Args:
        means: centres, world units.
        viewmat: world -> camera, rigid.
        v_means_cam: cotangent of the camera-frame centres.

    Returns:
        Cotangents of `means` and `viewmat`.

    Example:
        >>> v_means, v_viewmat = means_cam_from_means_vjp(np.array([[1.0, 2.0, 4.0]]), np.eye(4), np.eye(3)[:1])
        >>> v_viewmat[0]
        array([1., 2., 4., 1.])
    """
    R = viewmat[:3, :3]
    v_means = np.zeros(means.shape)
    v_viewmat = np.zeros((4, 4))
    for i in range(len(means)):
        v_means[i] = R.T @ v_means_cam[i]
        v_viewmat[:3, :3] += np.outer(v_means_cam[i], means[i])
        v_viewmat[:3, 3] += v_means_cam[i]
    return v_means, v_viewmat


def covars_cam_from_covars(
    covars: Float64[np.ndarray, "N 3 3"], viewmat: Float64[np.ndarray, "4 4"]
) -> Float64[np.ndarray, "N 3 3"]:
    """Turn covariances into the camera frame: `Sigma_cam = R Sigma R^T`.

    Source: Zwicker et al. 2001 (EWA), the viewing transformation W of Kerbl et al. 2023 (3DGS), eq. 5.
    Departs: nothing.

    Args:
        covars: covariances, world frame, world units squared.
        viewmat: world -> camera, rigid.

    Returns:
        Covariances, camera frame, world units squared.

    Example:
        >>> viewmat = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        >>> np.diag(covars_cam_from_covars(np.diag([1.0, 2.0, 4.0])[None], viewmat)[0])
        array([2., 1., 4.])
    """
    R = viewmat[:3, :3]
    covars_cam = np.zeros(covars.shape)
    for i in range(len(covars)):
        covars_cam[i] = R @ covars[i] @ R.T
    return covars_cam


def covars_cam_from_covars_vjp(
    covars: Float64[np.ndarray, "N 3 3"],
    viewmat: Float64[np.ndarray, "4 4"],
    v_covars_cam: Float64[np.ndarray, "N 3 3"],
) -> tuple[Float64[np.ndarray, "N 3 3"], Float64[np.ndarray, "4 4"]]:
    """Pull a cotangent of camera-frame covariances back.

    With V = v_Sigma_cam: `v_Sigma = R^T V R`, `v_R = sum V R Sigma^T + V^T R Sigma`.

    Source: transpose of `covars_cam_from_covars`.
    Departs: nothing.

    Args:
        covars: covariances, world frame, world units squared.
        viewmat: world -> camera, rigid.
        v_covars_cam: cotangent of the camera-frame covariances, symmetric or not.

    Returns:
        Cotangents of `covars` and `viewmat`.

    Example:
        >>> v_covars, v_viewmat = covars_cam_from_covars_vjp(np.eye(3)[None], np.eye(4), np.eye(3)[None])
        >>> v_viewmat[0]
        array([2., 0., 0., 0.])
    """
    R = viewmat[:3, :3]
    v_covars = np.zeros(covars.shape)
    v_viewmat = np.zeros((4, 4))
    for i in range(len(covars)):
        V = v_covars_cam[i]
        v_covars[i] = R.T @ V @ R
        v_viewmat[:3, :3] += V @ R @ covars[i].T + V.T @ R @ covars[i]
    return v_covars, v_viewmat


def in_front(depths: Float64[np.ndarray, " N"], profile: Profile = PAPER) -> Bool[np.ndarray, " N"]:
    """Tell which Gaussians lie between the near and the far plane (D1).

    `near <= z <= far`, or `near < z <= far` where the profile's near plane is inclusive of the cull. The whole
    Gaussian is kept or culled by its centre, even if it straddles the plane. Where near is 0, a centre in the
    camera's own plane is culled too: it has no Jacobian.

    Source: Kerbl et al. 2023 (3DGS), section 6 (guard band), the value from the code bases.
    Departs: the paper names no distance (D1); gsplat culls z < 0.01, Inria z <= 0.2 and has no far plane.

    Args:
        depths: camera z, world units.
        profile: the near plane (0.01, itself kept) and the far plane (1e10), and their strictness.

    Returns:
        True where kept.

    Example:
        >>> in_front(np.array([-1.0, 0.01, 4.0])).tolist()
        [False, True, True]
    """
    beyond_near = depths > profile.near_plane if profile.near_inclusive else depths >= profile.near_plane
    return beyond_near & (depths > NEAREST) & (depths <= profile.far_plane)
