"""Gaussians to splats: all that happens to a Gaussian before a pixel is touched, and its transpose.

A culled row (D1, D2) is zero everywhere but in its depth, and gets a gradient of exactly zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pop_ref._shapes import Float64, Int64
from pop_ref.camera import (
    covars_cam_from_covars,
    covars_cam_from_covars_vjp,
    in_front,
    means_cam_from_means,
    means_cam_from_means_vjp,
    view_dirs,
    view_dirs_vjp,
)
from pop_ref.constants import PAPER, Profile
from pop_ref.covariance import covars_from_quats_scales, covars_from_quats_scales_vjp
from pop_ref.footprint import (
    compensations,
    compensations_vjp,
    conics_from_covars2d,
    conics_from_covars2d_vjp,
    low_pass,
    low_pass_vjp,
    on_screen,
    radii_from_covars2d,
)
from pop_ref.harmonics import colors_from_sh, colors_from_sh_vjp
from pop_ref.projection import (
    project_covars,
    project_covars_vjp,
    project_means,
    project_means_vjp,
    projection_jacobians,
    projection_jacobians_vjp,
)
from pop_ref.records import Camera, Gaussians, Splats


class Geometry(NamedTuple):
    """The chain of covariances of Gaussians in front of the camera, one row each."""

    means_cam: Float64[np.ndarray, "M 3"]
    covars: Float64[np.ndarray, "M 3 3"]
    covars_cam: Float64[np.ndarray, "M 3 3"]
    jacobians: Float64[np.ndarray, "M 2 3"]
    covars2d: Float64[np.ndarray, "M 2 2"]
    blurred: Float64[np.ndarray, "M 2 2"]
    opacities: Float64[np.ndarray, " M"]


class GaussianGradients(NamedTuple):
    """Cotangents of what `project` reads; `colors` is None unless colours were given."""

    means: Float64[np.ndarray, "N 3"]
    quats: Float64[np.ndarray, "N 4"]
    scales: Float64[np.ndarray, "N 3"]
    opacities: Float64[np.ndarray, " N"]
    sh: Float64[np.ndarray, "N n_sh 3"]
    viewmat: Float64[np.ndarray, "4 4"]
    colors: Float64[np.ndarray, "N D"] | None


def geometry(gaussians: Gaussians, camera: Camera, profile: Profile = PAPER, antialiased: bool = False) -> Geometry:
    """Run the covariance chain of Gaussians that are all in front of the camera.

    Source: Kerbl et al. 2023 (3DGS), eqs. 5 and 6.
    Departs: the frustum clamp (B1) and the low-pass, as `projection` and `footprint` say.

    Args:
        gaussians: all with camera z > 0.
        camera: the view.
        profile: clamp, low-pass.
        antialiased: multiply opacities by `footprint.compensations`.

    Returns:
        Every intermediate, from camera-frame centres to the opacity that blends.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
        >>> geometry(g, Camera(np.eye(4), K, 8, 8)).covars2d[0]
        array([[4., 0.],
               [0., 4.]])
    """
    means_cam = means_cam_from_means(gaussians.means, camera.viewmat)
    covars = covars_from_quats_scales(gaussians.quats, gaussians.scales)
    covars_cam = covars_cam_from_covars(covars, camera.viewmat)
    jacobians = projection_jacobians(means_cam, camera.K, camera.width, camera.height, profile)
    covars2d = project_covars(covars_cam, jacobians)
    blurred = low_pass(covars2d, profile.eps2d)
    opacities = gaussians.opacities
    if antialiased:
        opacities = opacities * compensations(covars2d, profile.eps2d)
    return Geometry(means_cam, covars, covars_cam, jacobians, covars2d, blurred, opacities)


def project(
    gaussians: Gaussians,
    camera: Camera,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    antialiased: bool = False,
    colors: Float64[np.ndarray, "N D"] | None = None,
) -> Splats:
    """Turn Gaussians into what one camera sees of them.

    Source: Kerbl et al. 2023 (3DGS), sections 4 and 6.
    Departs: the culls (D1, D2) and, with `antialiased`, the opacity factor, which also enters the extents (gsplat).

    Args:
        gaussians: activated.
        camera: the view.
        sh_degree: bands to use, default all that `gaussians.sh` has.
        profile: every constant.
        antialiased: multiply opacities by `footprint.compensations`.
        colors: colours of any number of channels, used instead of `gaussians.sh`.

    Returns:
        The splats, one row per Gaussian; a culled row is zero but for its depth.

    Raises:
        ValueError: the degree does not fit the coefficients, or `colors` are not of N Gaussians.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
        >>> project(g, Camera(np.eye(4), K, 8, 8)).radii.tolist()
        [[7, 7]]
    """
    n, width, height = len(gaussians), camera.width, camera.height
    if colors is not None and (colors.ndim != 2 or len(colors) != n):
        raise ValueError(f"colors has shape {list(colors.shape)}; it must be [{n}, D], a row a Gaussian")
    depths = means_cam_from_means(gaussians.means, camera.viewmat)[:, 2]
    front = np.flatnonzero(in_front(depths, profile))
    shape = geometry(_take(gaussians, front), camera, profile, antialiased)
    means2d = project_means(shape.means_cam, camera.K, width, height, profile)
    radii = radii_from_covars2d(shape.blurred, shape.opacities, profile)
    kept = np.flatnonzero(on_screen(means2d, radii, width, height, profile))
    rows = front[kept]
    if colors is None:
        seen = _take(gaussians, rows)
        seen_colors = colors_from_sh(seen.sh, view_dirs(seen.means, camera.viewmat), _degree(gaussians, sh_degree))
    else:
        seen_colors = colors[rows]
    return Splats(
        means2d=_scatter(n, rows, means2d[kept]),
        depths=depths,
        conics=_scatter(n, rows, conics_from_covars2d(shape.blurred)[kept]),
        opacities=_scatter(n, rows, shape.opacities[kept]),
        colors=_scatter(n, rows, seen_colors),
        radii=_scatter(n, rows, radii[kept]),
    )


def project_vjp(
    gaussians: Gaussians,
    camera: Camera,
    v_means2d: Float64[np.ndarray, "N 2"],
    v_conics: Float64[np.ndarray, "N 3"],
    v_opacities: Float64[np.ndarray, " N"],
    v_colors: Float64[np.ndarray, "N D"],
    v_depths: Float64[np.ndarray, " N"] | None = None,
    sh_degree: int | None = None,
    profile: Profile = PAPER,
    antialiased: bool = False,
    colors: Float64[np.ndarray, "N D"] | None = None,
) -> GaussianGradients:
    """Pull cotangents of splats back to the Gaussians and the camera.

    Which rows are culled is held fixed (D1, D2); extents are integers and pass nothing.

    Source: transpose of `project`.
    Departs: nothing.

    Args:
        gaussians: activated.
        camera: the view.
        v_means2d: cotangent of the screen centres.
        v_conics: cotangent of the conics.
        v_opacities: cotangent of the opacities that blend.
        v_colors: cotangent of the colours.
        v_depths: cotangent of the depths, default zero; a depth channel sends its colour cotangent here.
        sh_degree: as in `project`.
        profile: as in `project`.
        antialiased: as in `project`.
        colors: as in `project`.

    Returns:
        The cotangents; rows culled in `project` are exactly zero.

    Example:
        >>> g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
        >>> K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
        >>> zeros = np.zeros((1, 3))
        >>> project_vjp(g, Camera(np.eye(4), K, 8, 8), np.array([[1.0, 0.5]]), zeros, zeros[:, 0], zeros).means
        array([[2., 1., 0.]])
    """
    rows = np.flatnonzero(project(gaussians, camera, sh_degree, profile, antialiased, colors).visible)
    seen = _take(gaussians, rows)
    shape = geometry(seen, camera, profile, antialiased)
    n, K, width, height = len(gaussians), camera.K, camera.width, camera.height

    v_blurred = conics_from_covars2d_vjp(shape.blurred, v_conics[rows])
    v_covars2d = low_pass_vjp(shape.covars2d, profile.eps2d, v_blurred)
    v_seen_opacities = v_opacities[rows]
    if antialiased:
        v_factors = v_seen_opacities * seen.opacities
        v_covars2d = v_covars2d + compensations_vjp(shape.covars2d, profile.eps2d, v_factors)
        v_seen_opacities = v_seen_opacities * compensations(shape.covars2d, profile.eps2d)
    v_covars_cam, v_jacobians = project_covars_vjp(shape.covars_cam, shape.jacobians, v_covars2d)
    v_covars, v_viewmat_of_covars = covars_cam_from_covars_vjp(shape.covars, camera.viewmat, v_covars_cam)
    v_quats, v_scales = covars_from_quats_scales_vjp(seen.quats, seen.scales, v_covars)

    v_means_cam = projection_jacobians_vjp(shape.means_cam, K, width, height, v_jacobians, profile)
    v_means_cam += project_means_vjp(shape.means_cam, K, width, height, v_means2d[rows], profile)
    if v_depths is not None:
        v_means_cam[:, 2] += v_depths[rows]
    v_means, v_viewmat = means_cam_from_means_vjp(seen.means, camera.viewmat, v_means_cam)
    v_viewmat += v_viewmat_of_covars

    v_sh = np.zeros_like(seen.sh)
    if colors is None:
        dirs = view_dirs(seen.means, camera.viewmat)
        v_sh, v_dirs = colors_from_sh_vjp(seen.sh, dirs, _degree(gaussians, sh_degree), v_colors[rows])
        v_means_of_dirs, v_viewmat_of_dirs = view_dirs_vjp(seen.means, camera.viewmat, v_dirs)
        v_means, v_viewmat = v_means + v_means_of_dirs, v_viewmat + v_viewmat_of_dirs
    return GaussianGradients(
        means=_scatter(n, rows, v_means),
        quats=_scatter(n, rows, v_quats),
        scales=_scatter(n, rows, v_scales),
        opacities=_scatter(n, rows, v_seen_opacities),
        sh=_scatter(n, rows, v_sh),
        viewmat=v_viewmat,
        colors=None if colors is None else _scatter(n, rows, v_colors[rows]),
    )


def _take(gaussians: Gaussians, rows: Int64[np.ndarray, " M"]) -> Gaussians:
    return Gaussians(**{name: values[rows] for name, values in vars(gaussians).items()})


def _scatter(n: int, rows: Int64[np.ndarray, " M"], values: np.ndarray) -> np.ndarray:
    scattered = np.zeros((n, *values.shape[1:]), dtype=values.dtype)
    scattered[rows] = values
    return scattered


def _degree(gaussians: Gaussians, sh_degree: int | None) -> int:
    return math.isqrt(gaussians.sh.shape[1]) - 1 if sh_degree is None else sh_degree
