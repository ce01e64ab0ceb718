"""World to camera against homogeneous coordinates, and the near plane at its edge."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from pop_ref import INRIA, PAPER, camera
from tests.oracle.scenes import tilted_camera

RNG = np.random.default_rng(9)
VIEWMAT = tilted_camera().viewmat
MEANS = RNG.normal(size=(6, 3))


def test_the_center_is_where_the_inverse_sends_the_origin() -> None:
    np.testing.assert_allclose(camera.camera_center(VIEWMAT), np.linalg.inv(VIEWMAT)[:3, 3], atol=1e-15)


def test_the_center_lands_on_the_camera_s_origin() -> None:
    at_center = camera.means_cam_from_means(camera.camera_center(VIEWMAT)[None], VIEWMAT)
    np.testing.assert_allclose(at_center, 0.0, atol=1e-15)


def test_centres_are_transformed_as_homogeneous_points() -> None:
    homogeneous = np.concatenate([MEANS, np.ones((6, 1))], axis=1)
    np.testing.assert_allclose(
        camera.means_cam_from_means(MEANS, VIEWMAT), (homogeneous @ VIEWMAT.T)[:, :3], atol=1e-15
    )


def test_view_directions_have_the_length_of_the_camera_frame_centres() -> None:
    dirs, means_cam = camera.view_dirs(MEANS, VIEWMAT), camera.means_cam_from_means(MEANS, VIEWMAT)
    np.testing.assert_allclose(np.linalg.norm(dirs, axis=1), np.linalg.norm(means_cam, axis=1), rtol=1e-14)
    np.testing.assert_allclose(dirs @ VIEWMAT[:3, :3].T, means_cam, atol=1e-14)


def test_covariances_are_those_of_transformed_samples() -> None:
    samples = RNG.normal(size=(50, 3)) * [1.0, 2.0, 0.25]
    covar = np.cov(samples.T)
    moved = camera.means_cam_from_means(samples, VIEWMAT)
    np.testing.assert_allclose(camera.covars_cam_from_covars(covar[None], VIEWMAT)[0], np.cov(moved.T), atol=1e-13)


def test_the_near_plane_itself_is_kept_by_paper_and_culled_by_inria() -> None:
    for profile, kept in ((PAPER, True), (INRIA, False)):
        near = profile.near_plane
        depths = np.array([-1.0, 0.0, math.nextafter(near, 0.0), near, math.nextafter(near, 1.0)])
        assert camera.in_front(depths, profile).tolist() == [False, False, False, kept, True]


def test_the_far_plane_itself_is_kept() -> None:
    close = replace(PAPER, far_plane=8.0)
    assert camera.in_front(np.array([8.0, math.nextafter(8.0, 9.0)]), close).tolist() == [True, False]
