"""What rounding costs up to the screen: a running error analysis of projection, one row a Gaussian.

Every quantity x carries an error bound e(x), so that a computation in precision eps may be wrong by about eps * e(x).
Bounds follow the textbook rule on absolute values, `e(f(x)) = |df/dx| e(x) + |terms of f|`, so they grow where terms
cancel (needles, splats seen edge-on) and nowhere else. Bounds are of first order and hold for any order of evaluation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pop_ref.camera import camera_center, covars_cam_from_covars, in_front, means_cam_from_means, view_dirs
from pop_ref.conformance.scenes import Scene
from pop_ref.covariance import covars_from_quats_scales, rotmats_from_quats
from pop_ref.footprint import compensations, conics_from_covars2d, low_pass
from pop_ref.harmonics import colors_from_sh, sh_basis
from pop_ref.magnitudes import in_float32
from pop_ref.projection import project_covars, project_means, projection_jacobians

TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True)
class ScreenErrorBounds:
    """Screen quantities in float64 with their error bounds; rows behind the near plane are left at zero.

    Attributes:
        kept: in front of the near plane with a positive determinant. [N]
        near: the near plane's decision is within `reach` (D1). [N]
        kinked: a frustum clamp or a colour clamp is within `reach` (B1, B2). [N]
        depths, e_depths: camera z. [N]
        means2d, e_means2d: px. [N, 2]
        conics, e_conics: px^-2. [N, 3]
        det, e_det: determinant of the blurred screen covariance, px^4. [N]
        opacities, e_opacities: that blend. [N]
        colors, e_colors: before and after the clamp at 0. [N, 3]
        means_cam, covars_cam, jacobians, covars2d: intermediate values, and e_ of each, for gradients.
    """

    kept: np.ndarray
    near: np.ndarray
    kinked: np.ndarray
    depths: np.ndarray
    e_depths: np.ndarray
    means2d: np.ndarray
    e_means2d: np.ndarray
    conics: np.ndarray
    e_conics: np.ndarray
    det: np.ndarray
    e_det: np.ndarray
    opacities: np.ndarray
    e_opacities: np.ndarray
    colors: np.ndarray
    e_colors: np.ndarray
    means_cam: np.ndarray
    e_means_cam: np.ndarray
    covars_cam: np.ndarray
    e_covars_cam: np.ndarray
    jacobians: np.ndarray
    e_jacobians: np.ndarray
    covars2d: np.ndarray
    e_covars2d: np.ndarray


def _t(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, -1, -2)


def _in_float32(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float32).astype(np.float64) == values


def _camera_error_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return e(means_cam) and e(covars_cam)."""
    g, viewmat = scene.gaussians, scene.camera.viewmat
    R, t = viewmat[:3, :3], viewmat[:3, 3]
    terms = np.concatenate([R[None] * g.means[:, None, :], np.broadcast_to(t[:, None], (len(g), 3, 1))], axis=2)
    # sums of short dyadic numbers are exact in any precision: only so can depths tie on purpose
    exact = np.all(_in_float32(terms) & _in_float32(np.cumsum(terms, axis=2)), axis=2)
    e_means_cam = np.where(exact, 0.0, 2.0 * np.sum(np.abs(terms), axis=2))
    A = np.abs(rotmats_from_quats(g.quats))
    variances = g.scales[:, None, :] ** 2
    e_covars = 4.0 * (A * variances) @ _t(A) + 2.0 * (
        np.sum(A * variances, 2)[:, :, None] + np.sum(A * variances, 2)[:, None, :]
    )
    covars = np.abs(covars_from_quats_scales(g.quats, g.scales))
    return e_means_cam, np.abs(R) @ (e_covars + 4.0 * covars) @ np.abs(R).T


def _jacobian_error_bounds(means_cam: np.ndarray, e: np.ndarray, J: np.ndarray) -> np.ndarray:
    z = np.maximum(np.abs(means_cam[:, 2]), TINY)
    relative = e[:, 2] / z + 2.0
    e_J = np.abs(J) * relative[:, None, None]
    for axis in range(2):
        focal_over_z = np.abs(J[:, axis, axis])
        e_J[:, axis, 2] = 2.0 * np.abs(J[:, axis, 2]) * relative + focal_over_z * (e[:, axis] / z)
    return e_J


def _conic_error_bounds(covars2d: np.ndarray, e_covars2d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    a, b, c = covars2d[:, 0, 0], np.abs(covars2d[:, 0, 1]), covars2d[:, 1, 1]
    e_a, e_b, e_c = e_covars2d[:, 0, 0], e_covars2d[:, 0, 1], e_covars2d[:, 1, 1]
    det = covars2d[:, 0, 0] * covars2d[:, 1, 1] - covars2d[:, 0, 1] * covars2d[:, 1, 0]
    e_det = c * e_a + a * e_c + 2.0 * b * e_b + a * c + b * b
    safe = np.where(det > 0.0, det, np.inf)
    e_conics = np.stack([(e + x * (e_det / safe + 2.0)) / safe for x, e in ((c, e_c), (b, e_b), (a, e_a))], axis=1)
    return det, e_det, e_conics


def _color_error_bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours, their error bounds, and the sums before the clamp at 0."""
    g = scene.gaussians
    degree = round(np.sqrt(g.sh.shape[1])) - 1 if scene.sh_degree is None else scene.sh_degree
    n_sh = (degree + 1) ** 2
    dirs = view_dirs(g.means, scene.camera.viewmat)
    length = np.maximum(np.linalg.norm(dirs, axis=1), TINY)
    basis = sh_basis(dirs / length[:, None], degree)
    center = np.linalg.norm(scene.camera.viewmat[:3, 3]) + np.linalg.norm(camera_center(scene.camera.viewmat))
    # a unit direction moves by eps (|mean| + 2 |center|) / distance, a basis function by at most 2 degree^2 times that
    e_dirs = (np.linalg.norm(g.means, axis=1) + 2.0 * center) / length + 4.0
    e_basis = 4.0 * np.abs(basis) + (2.0 * degree**2 * e_dirs)[:, None]
    e_colors = np.einsum("nk,nkc->nc", e_basis, np.abs(g.sh[:, :n_sh])) + 1.0
    sums = np.einsum("nk,nkc->nc", basis, g.sh[:, :n_sh]) + 0.5
    return colors_from_sh(g.sh, dirs, degree), e_colors, sums


def _clamp_in_reach(scene: Scene, p: np.ndarray, e_p: np.ndarray, reach: float) -> np.ndarray:
    """Tell whose x/z or y/z is within reach of the frustum clamp (B1)."""
    camera, profile = scene.camera, scene.profile
    near = np.zeros(len(p), dtype=bool)
    for axis, size in ((0, camera.width), (1, camera.height)):
        f = camera.K[axis, axis]
        c = 0.5 * size if profile.principal_point == "centred" else camera.K[axis, 2]
        margin = profile.frustum_margin * 0.5 * size / f
        slope = p[:, axis] / p[:, 2]
        e_slope = (e_p[:, axis] + np.abs(slope) * e_p[:, 2]) / p[:, 2] + np.abs(slope)
        for limit in (-(c / f + margin), (size - c) / f + margin):
            near |= np.abs(slope - limit) <= reach * (e_slope + (np.abs(c) + size) / f)
    return near


def screen_error_bounds(scene: Scene, reach: float) -> ScreenErrorBounds:
    """Carry error bounds from the scene to the screen; note decisions within reach of them."""
    g, camera, profile = scene.gaussians, scene.camera, scene.profile
    N = len(g)
    e_p, e_S = _camera_error_bounds(scene)
    p = means_cam_from_means(g.means, camera.viewmat)
    kept = in_front(p[:, 2], profile)
    depths = p[:, 2]
    # the constant itself may have to be rounded
    e_plane = 0.0 if in_float32(profile.near_plane) else profile.near_plane
    near = np.abs(depths - profile.near_plane) <= reach * (e_p[:, 2] + e_plane)
    # rows behind the camera take no part; a harmless point in their place keeps every formula finite
    p = np.where((kept | near)[:, None], p, np.array([0.0, 0.0, 1.0]))
    z = p[:, 2]
    means2d = project_means(p, camera.K, camera.width, camera.height, profile)
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    shift = means2d - focal * p[:, :2] / z[:, None]
    slopes = np.abs(focal * p[:, :2]) / z[:, None]
    e_means2d = (
        focal / z[:, None] * e_p[:, :2] + slopes * (e_p[:, 2] / z + 2.0)[:, None] + np.abs(shift) + np.abs(means2d)
    )
    S = covars_cam_from_covars(covars_from_quats_scales(g.quats, g.scales), camera.viewmat)
    J = projection_jacobians(p, camera.K, camera.width, camera.height, profile)
    e_J = _jacobian_error_bounds(p, e_p, J)
    A = np.abs(J)
    e_2d = A @ (e_S + 4.0 * np.abs(S)) @ _t(A) + e_J @ np.abs(S) @ _t(A) + A @ np.abs(S) @ _t(e_J)
    raw = project_covars(S, J)
    covars2d = low_pass(raw, profile.eps2d)
    e_2d = e_2d + np.abs(covars2d)
    det, e_det, e_conics = _conic_error_bounds(covars2d, e_2d)
    opacities, e_opacities = g.opacities, g.opacities.copy()
    if scene.antialiased:
        opacities, e_opacities = _antialiased(g.opacities, raw, e_2d, det, e_det, profile.eps2d)
    colors, e_colors, sums = _color_error_bounds(scene) if N else (np.zeros((0, 3)),) * 3
    kinked = _clamp_in_reach(scene, p, e_p, reach) | np.any(np.abs(sums) <= reach * e_colors, axis=1)
    return ScreenErrorBounds(
        kept=kept & (det > 0.0), near=near, kinked=kinked, depths=depths, e_depths=e_p[:, 2],
        means2d=means2d, e_means2d=e_means2d, conics=conics_from_covars2d(covars2d), e_conics=e_conics,
        det=det, e_det=e_det, opacities=opacities, e_opacities=e_opacities, colors=colors, e_colors=e_colors,
        means_cam=p, e_means_cam=e_p, covars_cam=S, e_covars_cam=e_S, jacobians=J, e_jacobians=e_J,
        covars2d=covars2d, e_covars2d=e_2d,
    )  # fmt: skip


def _antialiased(
    opacities: np.ndarray, raw: np.ndarray, e_2d: np.ndarray, det: np.ndarray, e_det: np.ndarray, eps2d: float
) -> tuple[np.ndarray, np.ndarray]:
    factors = compensations(raw, eps2d)
    raw_det, e_raw_det, _ = _conic_error_bounds(raw, e_2d)
    relative = e_raw_det / np.maximum(raw_det, TINY) + e_det / np.maximum(det, TINY) + 4.0
    # near zero sqrt(max(0, x)) is wrong by the root of x's error, which no multiple of eps bounds: let it be huge
    return opacities * factors, opacities * factors * np.minimum(relative, 1e30)
