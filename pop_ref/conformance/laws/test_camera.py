"""Laws of the camera frame and the near plane."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic, quats, reals, rigid, viewmats
from pop_ref.constants import PROFILES

points = arrays_of((3, 3), -8.0, 8.0)


def _seen(backend, viewmat):
    return viewmat.astype(backend.dtype).astype(np.float64)


@law("camera", "camera_center", "means_cam_from_means", viewmat=viewmats())
def test_the_camera_stands_at_the_origin_of_its_own_frame(backend, viewmat):
    V = _seen(backend, viewmat)
    center = backend.stage("camera_center")(V)
    origin = backend.stage("means_cam_from_means")(center[None], V)
    assert_close("camera.rigid", origin, np.zeros((1, 3)), 1.0 + np.linalg.norm(V[:3, 3]), backend.dtype)


@law("camera", "means_cam_from_means", points=points, viewmat=viewmats())
def test_a_rigid_motion_keeps_distances(backend, points, viewmat):
    V = _seen(backend, viewmat)
    moved = backend.stage("means_cam_from_means")(points, V)
    size = np.max(np.abs(points)) + np.max(np.abs(V[:3, 3])) + 1.0
    for i, j in ((0, 1), (1, 2), (2, 0)):
        before, after = np.linalg.norm(points[i] - points[j]), np.linalg.norm(moved[i] - moved[j])
        assert_close("camera.rigid", after, before, size, backend.dtype)


@law("camera", "means_cam_from_means", points=points, shift=arrays_of((3,), -4.0, 4.0))
def test_without_a_turn_a_point_is_shifted_exactly(backend, points, shift):
    viewmat = np.eye(4)
    viewmat[:3, 3] = shift
    assert_same_bits("camera point", backend.stage("means_cam_from_means")(points, viewmat), points + shift)


@law("camera", "means_cam_from_means")
def test_the_camera_looks_along_plus_z_with_y_down(backend):
    # a camera one unit above the origin in a world with z up, looking along world +y: OpenCV axes x right, y down
    viewmat = np.array([[1.0, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 0], [0, 0, 0, 1]])
    seen = backend.stage("means_cam_from_means")(np.array([[0.25, 4.0, 1.0], [0.0, 4.0, 3.0]]), viewmat)
    assert_same_bits("camera point", seen, np.array([[0.25, 0.0, 4.0], [0.0, -2.0, 4.0]]))


@law("camera", "view_dirs", "camera_center", points=points, viewmat=viewmats())
def test_view_directions_start_at_the_camera_and_end_at_the_gaussians(backend, points, viewmat):
    V = _seen(backend, viewmat)
    center = backend.stage("camera_center")(V)
    dirs = backend.stage("view_dirs")(points, V)
    size = np.abs(points) + np.sum(np.abs(V[:3, 3])) + 1.0
    assert_close("camera.dirs", dirs + center, points, size, backend.dtype)


@law("camera", "view_dirs", "means_cam_from_means", points=points, viewmat=viewmats())
def test_a_view_direction_turned_into_the_camera_is_the_camera_point(backend, points, viewmat):
    V = _seen(backend, viewmat)
    dirs = backend.stage("view_dirs")(points, V)
    camera_points = backend.stage("means_cam_from_means")(points, V)
    size = np.max(np.abs(points)) + np.max(np.abs(V[:3, 3])) + 1.0
    assert_close("camera.rigid", dirs @ V[:3, :3].T, camera_points, size, backend.dtype)


@law("camera", "covars_cam_from_covars", turn=quats(), factor=arrays_of((1, 3, 3)))
def test_a_turn_conjugates_covariances_and_keeps_their_eigenvalues(backend, turn, factor):
    R = _seen(backend, rigid(turn, (1.0, 2.0, 3.0)))
    covar = factor @ np.swapaxes(factor, 1, 2)
    turned = backend.stage("covars_cam_from_covars")(covar, R)[0]
    size = np.max(np.abs(covar)) + np.finfo(np.float32).tiny
    assert_close("camera.covariance", turned, R[:3, :3] @ covar[0] @ R[:3, :3].T, size, backend.dtype)
    assert_close("camera.covariance", np.trace(turned), np.trace(covar[0]), size, backend.dtype)


@law("camera", "in_front", name=st.sampled_from(sorted(PROFILES)), offset=dyadic(0.125, 8.0))
def test_the_near_plane_keeps_what_lies_beyond_it_and_decides_equality_by_profile(backend, name, offset):
    # D1
    profile = PROFILES[name]
    near = profile.near_plane
    depths = np.array([near + offset, near - offset, -near, 0.0])
    assert_same_bits("in front", backend.stage("in_front")(depths, profile), [True, False, False, False])
    if backend.dtype == np.float64:
        at = backend.stage("in_front")(np.array([near, np.nextafter(near, 1.0), np.nextafter(near, 0.0)]), profile)
        assert_same_bits("on the near plane", at, [not profile.near_inclusive, True, False])


@law("camera", "in_front", depth=reals(0.5, 1000.0))
def test_the_far_plane_is_beyond_every_scene(backend, depth):
    assert_same_bits("in front", backend.stage("in_front")(np.array([depth, 2e10])), [True, False])
