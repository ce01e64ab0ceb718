"""Laws of the camera: its frame, the near plane, the pinhole and its Jacobian."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.capabilities import HOMOGENEOUS
from pop_ref.conformance.capabilities import PROFILES as PROFILES_NEEDED
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic, quats, reals, rigid, viewmats
from pop_ref.constants import INRIA, PAPER, PROFILES

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


W, H = 8, 4
K = np.array([[8.0, 0.0, 3.0], [0.0, 16.0, 2.5], [0.0, 0.0, 1.0]])
coordinate = reals(-4.0, 4.0, dull=0.0)
ahead = st.tuples(coordinate, coordinate, reals(0.25, 8.0, dull=1.0)).map(lambda p: np.array([p]))
factors = arrays_of((1, 3, 3))
# a pinhole's: implementations may rely on its two zeros
pinholes = arrays_of((4,)).map(lambda j: np.array([[[j[0], 0.0, j[1]], [0.0, j[2], j[3]]]]))
NO_CLAMP = dataclasses.replace(PAPER, frustum_margin=1e6)


def _slope_limits(profile, intrinsics=K):
    fx, fy = intrinsics[0, 0], intrinsics[1, 1]
    cx, cy = (W / 2, H / 2) if profile.principal_point == "centred" else (intrinsics[0, 2], intrinsics[1, 2])
    mx, my = profile.frustum_margin * W / (2 * fx), profile.frustum_margin * H / (2 * fy)
    return (-cx / fx - mx, (W - cx) / fx + mx), (-cy / fy - my, (H - cy) / fy + my)


@law("projection", "project_means", point=ahead)
def test_a_point_on_the_axis_lands_on_the_principal_point_and_others_to_its_right_and_below(backend, point):
    project = backend.stage("project_means")
    axis = np.array([[0.0, 0.0, point[0, 2]]])
    assert_close("projection.axis", project(axis, K, W, H), np.array([[3.0, 2.5]]), 8.0, backend.dtype)
    u, v = project(np.abs(point), K, W, H)[0]
    slack = 16.0 * np.finfo(backend.dtype).eps
    assert u >= 3.0 - slack
    assert v >= 2.5 - slack


@law("projection", "project_means", PROFILES_NEEDED, point=ahead)
def test_where_the_profile_says_so_the_principal_point_is_the_images_centre(backend, point):
    axis = np.array([[0.0, 0.0, point[0, 2]]])
    centre = np.array([[W / 2.0, H / 2.0]])
    assert_close("projection.axis", backend.stage("project_means")(axis, K, W, H, INRIA), centre, 8.0, backend.dtype)


@law("projection", "project_means", "projection_jacobians", HOMOGENEOUS, point=ahead, power=st.integers(-4, 4))
def test_scaling_the_world_by_a_power_of_two_keeps_the_screen_and_divides_the_jacobian_exactly(backend, point, power):
    project, jacobians = backend.stage("project_means"), backend.stage("projection_jacobians")
    scale = 2.0**power
    assert_same_bits("means2d", project(scale * point, K, W, H), project(point, K, W, H))
    assert_same_bits("jacobian", jacobians(scale * point, K, W, H) * scale, jacobians(point, K, W, H))


@law("projection", "project_means", "projection_jacobians", point=ahead)
def test_doubling_the_resolution_doubles_screen_positions_and_jacobians_exactly(backend, point):
    project, jacobians = backend.stage("project_means"), backend.stage("projection_jacobians")
    fine = K * np.array([[2.0], [2.0], [1.0]])
    assert_same_bits("means2d", project(point, fine, 2 * W, 2 * H), 2.0 * project(point, K, W, H))
    assert_same_bits("jacobian", jacobians(point, fine, 2 * W, 2 * H), 2.0 * jacobians(point, K, W, H))


@law("projection", "project_means", point=ahead, dx=dyadic(-4.0, 4.0), dy=dyadic(-4.0, 4.0))
def test_shifting_the_principal_point_translates_the_screen(backend, point, dx, dy):
    project = backend.stage("project_means")
    shifted = K + np.array([[0.0, 0.0, dx], [0.0, 0.0, dy], [0.0, 0.0, 0.0]])
    before = project(point, K, W, H)
    size = np.abs(before) + 8.0
    assert_close("projection.shift", project(point, shifted, W, H), before + np.array([dx, dy]), size, backend.dtype)


@law(
    "projection",
    "project_means",
    "projection_jacobians",
    PROFILES_NEEDED,
    point=ahead,
    step=arrays_of((1, 3), -1.0, 1.0),
)
def test_the_jacobian_is_the_derivative_of_the_projection(backend, point, step):
    # the central difference of a pinhole along a direction is exact but for the square of h / z
    project = backend.stage("project_means")
    J = backend.stage("projection_jacobians")(point, K, W, H, NO_CLAMP)[0]
    h = 2.0 ** (-17 if backend.dtype == np.float64 else -6) * point[0, 2]
    slope = (project(point + h * step, K, W, H) - project(point - h * step, K, W, H))[0] / (2.0 * h)
    expected = J @ step[0]
    size = np.abs(J) @ np.abs(step[0]) + np.max(np.abs(J))
    magnitude = size * (1.0 + np.max(np.abs(point)) / point[0, 2])
    truncation = 2.0 * (h / point[0, 2]) ** 2 * magnitude / np.finfo(backend.dtype).eps
    rounding = (np.max(np.abs(project(point, K, W, H))) + 8.0) / h
    assert_close("projection.jacobian", slope, expected, magnitude + truncation + rounding, backend.dtype)


@law("projection", "projection_jacobians", point=ahead, name=st.sampled_from(sorted(PROFILES)))
def test_outside_the_frustum_the_jacobian_is_that_of_the_clamped_point(backend, point, name):
    # B1
    profile = PROFILES[name]
    limits_x, limits_y = _slope_limits(profile)
    x, y, z = point[0]
    clamped = np.array([[np.clip(x / z, *limits_x) * z, np.clip(y / z, *limits_y) * z, z]])
    jacobians = backend.stage("projection_jacobians")
    J, expected = jacobians(point, K, W, H, profile), jacobians(clamped, K, W, H, profile)
    assert_close("projection.clamp", J, expected, np.abs(expected) + 1.0 / z, backend.dtype)
    fx, fy = K[0, 0], K[1, 1]
    written = np.array([[[fx / z, 0, -fx * clamped[0, 0] / z**2], [0, fy / z, -fy * clamped[0, 1] / z**2]]])
    assert_close("projection.clamp", J, written, np.abs(written) + fx / z, backend.dtype)


@law("projection", "projection_jacobians_vjp", PROFILES_NEEDED, point=ahead, v=arrays_of((1, 2, 3), -1.0, 1.0))
def test_a_clamped_point_passes_no_gradient_sideways_and_profiles_differ_in_depth_only(backend, point, v):
    # B1: outside on both axes
    x, y, z = np.where(point[0] < 0.0, -40.0, 40.0) * np.array([1.0, 1.0, 0.0]) + [0.0, 0.0, point[0, 2]]
    out = np.array([[x, y, z]])
    pull = backend.stage("projection_jacobians_vjp")
    exact = pull(out, K, W, H, v, dataclasses.replace(PAPER, principal_point="centred"))
    inria = pull(out, K, W, H, v, dataclasses.replace(INRIA))
    assert_same_bits("sideways", np.array([exact[0, :2], inria[0, :2]]), np.zeros((2, 2)))
    only_offsets = v * np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]])
    exact, inria = (
        pull(out, K, W, H, only_offsets, p) for p in (dataclasses.replace(PAPER, principal_point="centred"), INRIA)
    )
    size = np.sum(np.abs(v)) * 64.0 / z**2
    assert_close("projection.clamp_gradient", inria[0, 2], 2.0 * exact[0, 2], size, backend.dtype)


@law("projection", "project_covars", factor=factors, jacobian=pinholes)
def test_screen_covariances_are_symmetric_and_never_negative(backend, factor, jacobian):
    covar = factor @ np.swapaxes(factor, 1, 2)
    flat = backend.stage("project_covars")(covar, jacobian)[0]
    size = np.max(np.abs(jacobian)) ** 2 * np.max(np.abs(covar)) + 1.0
    assert_close("projection.covariance", flat, flat.T, size, backend.dtype)
    lowest = min(float(np.linalg.eigvalsh(0.5 * (flat + flat.T))[0]), 0.0)
    assert_close("projection.covariance", lowest, 0.0, size, backend.dtype)


@law("projection", "project_covars", factor=factors, jacobian=pinholes, turn=st.integers(0, 3))
def test_a_screen_covariance_is_the_spread_of_the_projected_axes(backend, factor, jacobian, turn):
    covar = factor @ np.swapaxes(factor, 1, 2)
    axes = np.roll(jacobian[0] @ factor[0], turn, axis=1)
    expected = sum(np.outer(axes[:, k], axes[:, k]) for k in range(3))
    flat = backend.stage("project_covars")(covar, jacobian)[0]
    size = np.max(np.abs(jacobian)) ** 2 * np.max(np.abs(covar)) + 1.0
    assert_close("projection.covariance", flat, expected, size, backend.dtype)
