"""Laws of points on rays: where along a pixel's ray its Gaussian is densest."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from pop_ref.chord import dominant_points
from pop_ref.compositing import composite
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.score_error_bounds import screened
from pop_ref.conformance.strategies import arrays_of, plain_sizes, quats, scenes
from pop_ref.constants import INRIA
from pop_ref.records import Camera, Gaussians

vectors = arrays_of((3,), -4.0, 4.0)
rays = vectors.map(lambda d: d if np.any(d) else np.array([0.0, 0.0, 1.0]))
shapes = st.tuples(*[st.sampled_from([0.25, 0.5, 1.0, 2.0])] * 3).map(np.array)
plain = scenes(anchored=True, size=plain_sizes())


@law("chord", "chord_midpoint", mean=vectors, quat=quats().map(np.array), scale=shapes, origin=vectors, direction=rays)
def test_a_gaussian_is_densest_at_the_midpoint(backend, mean, quat, scale, origin, direction):
    t = backend.stage("chord_midpoint")(mean, quat, scale, origin, direction)
    w, x, y, z = quat / np.linalg.norm(quat)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    precision = (R := np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross) @ np.diag(scale**-2.0) @ R.T
    # the slope of |.|^2 / 2 along the ray, which is 0 there
    slope = direction @ precision @ (origin + t * direction - mean)
    size = np.abs(direction) @ np.abs(precision) @ (np.abs(origin) + abs(t) * np.abs(direction) + np.abs(mean))
    spread = float(np.max(scale) / np.min(scale)) ** 2
    assert_close("chord.densest", slope, 0.0, size * spread, backend.dtype)


@law("chord", "chord_midpoint", mean=vectors, quat=quats().map(np.array), scale=shapes, origin=vectors, direction=rays)
def test_midpoints_are_counted_in_lengths_of_the_direction(backend, mean, quat, scale, origin, direction):
    # a power of two rounds nothing
    midpoint = backend.stage("chord_midpoint")
    whole = midpoint(mean, quat, scale, origin, direction)
    assert_same_bits("a ray twice as long", midpoint(mean, quat, scale, origin, 2.0 * direction), 0.5 * whole)
    assert_same_bits("a Gaussian twice as large", midpoint(mean, quat, 2.0 * scale, origin, direction), whole)
    assert_same_bits("a ray backwards", midpoint(mean, quat, scale, origin, -direction), -whole)


def _drawn(backend, given):
    splats, lists, _, _, size = given.view
    seen = given.scene
    args = (splats, lists, seen.gaussians, seen.camera, size, seen.profile)
    return backend.stage("dominant_points")(*args), dominant_points(*args)


@law("chord", "dominant_points", scene=plain)
def test_dominant_points_are_the_oracles(backend, scene):
    given = screened(backend, scene)
    found, expected = _drawn(backend, given)
    g, camera = given.scene.gaussians, given.scene.camera
    # what is ahead of the camera everywhere on its ellipsoid is ahead on every ray
    reach = np.linalg.norm(g.means + camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3], axis=1)
    ahead = bool(np.all(reach[given.splats.visible] > 4.0 * np.max(g.scales[given.splats.visible], initial=0.0)))
    sure = given.error_bounds.decided & ahead
    assert_same_bits("ids", found.ids[sure], expected.ids[sure])
    same = sure & (expected.ids >= 0)
    ids = expected.ids[same]
    spread = (np.max(g.scales[ids], axis=1) / np.min(g.scales[ids], axis=1)) ** 2
    center = np.linalg.norm(camera.viewmat[:3, 3])
    size = (np.abs(expected.points[same]).max(axis=1) + reach[ids] + 2.0 * center) * spread
    ends = found.points[same], expected.points[same]
    assert_close("agreement.points", *ends, size[:, None], backend.dtype, against_oracle=True)
    transmittance = found.T_final[given.error_bounds.unambiguous], expected.T_final[given.error_bounds.unambiguous]
    magnitude = (given.error_bounds.T_final + 1.0)[given.error_bounds.unambiguous]
    assert_close("agreement.points.T_final", *transmittance, magnitude, backend.dtype, against_oracle=True)


@law("chord", "dominant_points", scene=scenes(anchored=True))
def test_points_lie_on_the_rays_through_their_pixels_and_ahead_of_the_camera(backend, scene):
    given = screened(backend, scene)
    found, _ = _drawn(backend, given)
    camera = given.scene.camera
    some = found.ids >= 0
    assert np.any(some)
    p = found.points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    across = camera.K[0, 0] * p[..., 0] - (x - camera.K[0, 2]) * p[..., 2]
    down = camera.K[1, 1] * p[..., 1] - (y - camera.K[1, 2]) * p[..., 2]
    # what is lost where the point is far, or the camera is
    size = np.abs(found.points).max(axis=2) + np.linalg.norm(camera.viewmat[:3, 3])
    size = size * (camera.K[0, 0] + camera.K[1, 1] + np.abs(x - camera.K[0, 2]) + np.abs(y - camera.K[1, 2]))
    for off in (across, down):
        assert_close("chord.ray", off[some], np.zeros(int(np.sum(some))), size[some], backend.dtype)
    assert np.all(p[..., 2][some] >= -(2.0**6) * np.finfo(backend.dtype).eps * size[some])
    assert_same_bits("points of no Gaussian", found.points[~some], np.zeros((int(np.sum(~some)), 3)))


@law(
    "chord",
    "dominant_points",
    side=st.sampled_from([0.25, -0.25, 0.375]),
    depth=st.sampled_from([0.125, 0.0625]),
    opacity=st.sampled_from([0.5, 1.0, 0.75]),
)
def test_a_gaussian_that_is_densest_behind_the_camera_gives_no_point(backend, side, depth, opacity):
    # a long one just ahead, slanted by 45 degrees towards the axis, which its line crosses at depth - |side| < 0
    camera = Camera(np.eye(4), np.array([[4.0, 0, 2.5], [0, 4.0, 2.5], [0, 0, 1]]), 5, 5)
    half = math.copysign(math.pi / 8.0, side)
    slanted = ([side, 0.0, depth], [math.cos(half), 0.0, math.sin(half), 0.0], [0.5, 0.5, 2.0], opacity)
    round_ = ([0.0, 0.0, 4.0], [1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 1.0], 0.5)
    columns = [np.array(column) for column in zip(slanted, round_, strict=True)]
    given = screened(backend, Scene(Gaussians(*columns, np.zeros((2, 1, 3))), camera))
    found, expected = _drawn(backend, given)
    drawn = composite(*given.view, profile=given.scene.profile)
    # blended first, and heaviest in the middle
    assert drawn.dominant_ids[2, 2] == 0
    assert expected.ids[2, 2] == found.ids[2, 2]
    assert found.ids[2, 2] != 0


@law("chord", "dominant_points", cx=st.sampled_from([0.5, 1.75, 4.0]), cy=st.sampled_from([-1.0, 0.5, 3.25]))
def test_where_the_profile_centres_the_principal_point_rays_pass_about_the_middle_of_the_picture(backend, cx, cy):
    camera = Camera(np.eye(4), np.array([[4.0, 0, cx], [0, 8.0, cy], [0, 0, 1]]), 5, 4)
    one = ([[0.0, 0.0, 4.0]], [[1.0, 0.0, 0.0, 0.0]], [[2.0, 2.0, 1.0]], [0.75], np.zeros((1, 1, 3)))
    given = screened(backend, Scene(Gaussians(*map(np.array, one)), camera, profile=INRIA))
    found, _ = _drawn(backend, given)
    some = found.ids >= 0
    assert np.any(some)
    x, y = np.meshgrid(np.arange(5) + 0.5 - 2.5, np.arange(4) + 0.5 - 2.0)
    p = found.points
    for off in (4.0 * p[..., 0] - x * p[..., 2], 8.0 * p[..., 1] - y * p[..., 2]):
        assert_close("chord.ray", off[some], 0.0 * off[some], 64.0, backend.dtype)


@law("chord", "dominant_points", scene=scenes(anchored=True))
def test_only_what_is_blended_at_a_pixel_gives_its_point(backend, scene):
    given = screened(backend, scene)
    found, _ = _drawn(backend, given)
    drawn = composite(*given.view, profile=given.scene.profile)
    sure = given.error_bounds.unambiguous
    assert np.all(found.ids[sure & (drawn.n_blended == 0)] == -1)
    assert np.all(given.splats.visible[found.ids[found.ids >= 0]])
    flat = np.any(given.scene.gaussians.scales == 0.0, axis=1)
    assert not np.any(flat[found.ids[found.ids >= 0]]), "a Gaussian without thickness has no densest point"
