"""Transposes of the world-to-camera stages against differences, the view matrix's twelve entries included."""

from __future__ import annotations

import numpy as np

from pop_ref import camera
from tests.gradients.checks import assert_vjp_matches
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(4)
VIEWMAT = tilted_camera().viewmat
MEANS = RNG.normal(size=(3, 3))
COVARS = RNG.normal(size=(3, 3, 3))


def test_center_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.camera_center, camera.camera_center_vjp, [VIEWMAT])


def test_view_directions_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.view_dirs, camera.view_dirs_vjp, [MEANS, VIEWMAT])


def test_camera_frame_centres_transpose_matches_differences() -> None:
    assert_vjp_matches(camera.means_cam_from_means, camera.means_cam_from_means_vjp, [MEANS, VIEWMAT])


def test_camera_frame_covariances_transpose_matches_differences_for_matrices_that_are_not_symmetric() -> None:
    assert_vjp_matches(camera.covars_cam_from_covars, camera.covars_cam_from_covars_vjp, [COVARS, VIEWMAT])


def test_the_view_matrix_s_last_row_gets_exactly_zero() -> None:
    for v_viewmat in (
        camera.camera_center_vjp(VIEWMAT, np.ones(3)),
        camera.view_dirs_vjp(MEANS, VIEWMAT, MEANS)[1],
        camera.means_cam_from_means_vjp(MEANS, VIEWMAT, MEANS)[1],
        camera.covars_cam_from_covars_vjp(COVARS, VIEWMAT, COVARS)[1],
    ):
        assert np.all(v_viewmat[3] == 0.0)
        assert np.any(v_viewmat[:3] != 0.0)


def test_the_center_s_gradient_agrees_with_matrix_inversion_along_rigid_motions() -> None:
    # gsplat differentiates the inverse instead: equal on the tangent directions of a rotation
    v_center, omega = RNG.normal(size=3), RNG.normal(size=3)
    spin = np.array([[0.0, -omega[2], omega[1]], [omega[2], 0.0, -omega[0]], [-omega[1], omega[0], 0.0]])
    motion = np.zeros((4, 4))
    motion[:3, :3] = spin @ VIEWMAT[:3, :3]
    motion[:3, 3] = RNG.normal(size=3)
    inverse = np.linalg.inv(VIEWMAT)
    through_inverse = v_center @ (-inverse @ motion @ inverse)[:3, 3]
    ours = np.sum(camera.camera_center_vjp(VIEWMAT, v_center) * motion)
    np.testing.assert_allclose(ours, through_inverse, rtol=1e-12)
