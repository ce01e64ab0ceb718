"""Laws of what methods sum over the pixels that blend a Gaussian.

Contributions; Speedy-Splat's score, the squared change of each pixel's summed colour; Fisher blocks, second moments of
the derivatives of every pixel and channel; and where along a pixel's ray its Gaussian is densest.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.chord import dominant_points
from pop_ref.compositing import composite, composite_vjp
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.gradient_error_bounds import (
    moment_error_bounds,
    parameter_error_bounds,
    screened,
    sensitivity_error_bounds,
    weight_error_bounds,
)
from pop_ref.conformance.law import law
from pop_ref.conformance.scenes import Scene
from pop_ref.conformance.strategies import arrays_of, dyadic, faint_opacities, plain_sizes, quats, scenes
from pop_ref.conformance.views import cameras, gaussians
from pop_ref.constants import INRIA, PROFILES
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.sensitivity import sensitivities

plain = scenes(anchored=True, size=plain_sizes())
faint = scenes(anchored=True, opacity=faint_opacities(), size=plain_sizes())


def pattern(height, width):
    """Return a map of dyadic numbers of either sign."""
    return (np.mod(np.arange(height * width, dtype=np.float64).reshape(height, width) * 5.0, 16.0) - 7.5) / 8.0


def permuted(given, order):
    """Return splats in another order, and lists that call them by their new rows."""
    splats = type(given.splats)(*(getattr(given.splats, f.name)[order] for f in dataclasses.fields(given.splats)))
    place = np.argsort(order)
    return dataclasses.replace(given, splats=splats, lists=[[int(place[i]) for i in ids] for ids in given.lists])


def shuffled(seed, n):
    """Return an order of n rows."""
    order = list(range(n))
    seed.shuffle(order)
    return np.array(order, dtype=np.int64)


@law("contributions", "contributions", scene=scenes(anchored=True))
def test_contributions_are_the_oracles(backend, scene):
    _agree_on_contributions(backend, screened(backend, scene))


@law("contributions", "contributions", scene=scenes(profile=INRIA, size=plain_sizes(), max_side=16))
def test_contributions_of_inrias_profile_are_the_oracles(backend, scene):
    _agree_on_contributions(backend, screened(backend, scene))


def _agree_on_contributions(backend, given):
    H, W = given.error_bounds.T_final.shape
    args = (*given.view, pattern(H, W), given.scene.profile)
    expected, found = contributions(*args), backend.stage("contributions")(*args)
    rows = given.sure
    weights, distances = weight_error_bounds(given.error_bounds)
    assert_same_bits("pixels", found.n_pixels[rows], expected.n_pixels[rows])
    error_bounds = {"weight_sum": weights, "map_sum": expected.n_pixels.astype(np.float64), "distance_sum": distances}
    for name, error_bound in error_bounds.items():
        ends = getattr(found, name)[rows], getattr(expected, name)[rows]
        assert_close(f"agreement.{name}", *ends, error_bound[rows], backend.dtype, against_oracle=True)


@law("contributions", "contributions", scene=plain)
def test_weights_and_the_light_that_is_left_cover_the_image(backend, scene):
    given = screened(backend, scene)
    # where a decision is near its threshold the oracle's transmittance may be quite another
    assume(bool(np.all(given.error_bounds.unambiguous)))
    drawn = composite(*given.view, profile=given.scene.profile)
    found = backend.stage("contributions")(*given.view, None, given.scene.profile)
    assert int(np.sum(found.n_pixels)) == int(np.sum(drawn.n_blended)) > 0
    total = np.sum(found.weight_sum) + np.sum(drawn.T_final)
    magnitude = np.sum(weight_error_bounds(given.error_bounds)[0]) + drawn.T_final.size
    assert_close("contributions.cover", total, drawn.T_final.size, magnitude, backend.dtype)


@law("contributions", "contributions", scene=plain)
def test_a_weight_is_what_a_colour_of_one_channel_adds_to_the_image(backend, scene):
    given = screened(backend, scene)
    splats, H, W = given.splats, *given.error_bounds.T_final.shape
    grey = dataclasses.replace(splats, colors=splats.colors[:, :1])
    v_colors = composite_vjp(grey, *given.view[1:], np.ones((H, W, 1)), profile=given.scene.profile).v_colors[:, 0]
    found = backend.stage("contributions")(*given.view, None, given.scene.profile).weight_sum
    rows, error_bound = given.sure, weight_error_bounds(given.error_bounds)[0]
    assert_close("contributions.color", found[rows], v_colors[rows], error_bound[rows], backend.dtype)


@law("contributions", "contributions", scene=scenes(anchored=True))
def test_who_is_blended_at_no_pixel_contributes_exactly_nothing(backend, scene):
    given = screened(backend, scene)
    H, W = given.error_bounds.T_final.shape
    found = backend.stage("contributions")(*given.view, pattern(H, W), given.scene.profile)
    nowhere = found.n_pixels == 0
    assert np.all(nowhere[~given.splats.visible])
    for name in ("weight_sum", "map_sum", "distance_sum"):
        assert_same_bits(name, getattr(found, name)[nowhere], np.zeros(int(np.sum(nowhere))))
    assert np.all(found.weight_sum[~nowhere] > 0.0)


@law("contributions", "contributions", scene=scenes(anchored=True), rows=st.integers(1, 4))
def test_a_map_that_marks_the_upper_part_of_an_image_counts_its_pixels(backend, scene, rows):
    given = screened(backend, scene)
    splats, lists, width, height, size = given.view
    upper = min(rows * size, height)
    marks = np.zeros((height, width))
    marks[:upper] = 1.0
    count = backend.stage("contributions")
    whole, below = (count(*given.view, m, given.scene.profile) for m in (marks, 1.0 - marks))
    above = count(splats, lists[: rows * -(-width // size)], width, upper, size, None, given.scene.profile)
    assert_same_bits("pixels of the upper part", whole.map_sum, above.n_pixels)
    assert_same_bits("pixels of both parts", whole.map_sum + below.map_sum, whole.n_pixels)
    assert np.all(above.distance_sum <= whole.distance_sum * (1.0 + 1e-3))


@law("contributions", "contributions", scene=plain, seed=st.randoms(use_true_random=False))
def test_contributions_stay_with_their_rows(backend, scene, seed):
    given = screened(backend, scene)
    order = shuffled(seed, len(scene.gaussians))
    profile, n_pixels = given.scene.profile, given.error_bounds.T_final.shape
    count = backend.stage("contributions")
    one = count(*given.view, pattern(*n_pixels), profile)
    other = count(*permuted(given, order).view, pattern(*n_pixels), profile)
    for name in ("weight_sum", "n_pixels", "map_sum", "distance_sum"):
        before = getattr(one, name)[order]
        magnitude = np.abs(before) + one.n_pixels[order]
        assert_close("contributions.rows", getattr(other, name), before, magnitude, backend.dtype)


def _scored(backend, given, background=None):
    shown = given.scene.background if background is None else background
    return backend.stage("sensitivities")(*given.view, shown, given.scene.profile)


def _agree_on_sensitivities(backend, given):
    expected = sensitivities(*given.view, given.scene.background, given.scene.profile)
    rows, error_bound = given.sure, sensitivity_error_bounds(given.error_bounds)
    found = _scored(backend, given)
    assert_close(
        "agreement.sensitivity", found[rows], expected[rows], error_bound[rows], backend.dtype, against_oracle=True
    )


@law("sensitivity", "sensitivities", scene=scenes(anchored=True))
def test_sensitivities_are_the_oracles(backend, scene):
    _agree_on_sensitivities(backend, screened(backend, scene))


@law("sensitivity", "sensitivities", scene=scenes(profile=INRIA, size=plain_sizes(), max_side=16))
def test_sensitivities_of_inrias_profile_are_the_oracles(backend, scene):
    _agree_on_sensitivities(backend, screened(backend, scene))


@law("sensitivity", "sensitivities", scene=scenes(anchored=True))
def test_who_is_blended_at_no_pixel_has_no_sensitivity(backend, scene):
    given = screened(backend, scene)
    scores = _scored(backend, given)
    counts = contributions(*given.view, None, given.scene.profile).n_pixels
    nowhere = given.sure & (counts == 0)
    assert_same_bits("scores", scores[nowhere], np.zeros(int(np.sum(nowhere))))
    assert np.all(scores >= 0.0)


@law("sensitivity", "sensitivities", scene=plain, seed=st.randoms(use_true_random=False))
def test_sensitivities_stay_with_their_rows(backend, scene, seed):
    given = screened(backend, scene)
    order = shuffled(seed, len(scene.gaussians))
    one, other = _scored(backend, given), _scored(backend, permuted(given, order))
    error_bound = sensitivity_error_bounds(given.error_bounds)[order]
    assert_close("sensitivity.rows", other, one[order], error_bound, backend.dtype)


@law("sensitivity", "sensitivities", scene=plain)
def test_twice_the_colours_are_four_times_the_sensitivity(backend, scene):
    given = screened(backend, scene)
    brighter = dataclasses.replace(given, splats=dataclasses.replace(given.splats, colors=2.0 * given.splats.colors))
    once = _scored(backend, given)
    twice = _scored(backend, brighter, 2.0 * given.scene.background)
    assert np.any(once > 0.0) or not np.any(given.splats.colors - given.scene.background)
    # a power of two rounds nothing, unless it underflows
    assert_close("sensitivity.square", twice, 4.0 * once, 4.0 * once, backend.dtype)


@law("sensitivity", "sensitivities", scene=plain, more=st.sampled_from([0.5, 1.0, 2.0]))
def test_the_same_light_added_to_everything_changes_no_sensitivity(backend, scene, more):
    given = screened(backend, scene)
    lit = dataclasses.replace(given, splats=dataclasses.replace(given.splats, colors=given.splats.colors + more))
    under = given.scene.with_overrides(background=given.scene.background + more)
    bright = _scored(backend, lit, under.background)
    # an error bound is of absolute values, so take it of the brighter scene
    error_bounds = dataclasses.replace(given.error_bounds, scene=under)
    error_bounds.screen = dataclasses.replace(given.error_bounds.screen, colors=given.error_bounds.screen.colors + more)
    error_bound = sensitivity_error_bounds(error_bounds)
    assert_close("sensitivity.light", bright, _scored(backend, given), error_bound, backend.dtype)


@law(
    "sensitivity",
    "sensitivities",
    opacity=st.sampled_from([0.5, 0.25, 1.0, 0.75]),
    colors=st.tuples(*[dyadic(-1.0, 2.0)] * 3),
    background=st.tuples(*[dyadic(0.0, 1.0)] * 3),
    away=st.sampled_from([0.0, 1.0, 0.5]),
    name=st.sampled_from(sorted(PROFILES)),
)
def test_one_splat_on_one_pixel_scores_its_opacity_times_its_contrast_squared(
    backend, opacity, colors, background, away, name
):
    # whatever its falloff there, and at the ceiling too
    shape = np.array([[0.5 + away, 0.5]]), np.ones(1), np.array([[1.0, 0.0, 1.0]])
    splats = Splats(*shape, np.array([opacity]), np.array([colors]), np.array([[4, 4]]))
    args = (splats, [[0]], 1, 1, 16, np.array(background), PROFILES[name])
    contrast = opacity * (math.fsum(colors) - math.fsum(background))
    size = (math.fsum(map(abs, colors)) + math.fsum(background)) ** 2
    assert_close("sensitivity.one", backend.stage("sensitivities")(*args), [contrast**2], size, backend.dtype)


UPPER = [(i, j) for i in range(5) for j in range(i, 5)]
shapely = scenes(anchored=True, size=plain_sizes(), max_gaussians=4, max_degree=3)


def _moments(backend, given):
    return backend.stage("screen_moments")(*given.view, given.scene.background, given.scene.profile)


def _agree_on_moments(backend, given):
    expected = screen_moments(*given.view, given.scene.background, given.scene.profile)
    rows = given.smooth
    error_bound = moment_error_bounds(given.error_bounds, 0.5 * given.tile_size)
    ends = _moments(backend, given)[rows], expected[rows]
    assert_close("agreement.screen_moments", *ends, error_bound[rows], backend.dtype, against_oracle=True)


@law("fisher", "screen_moments", scene=scenes(anchored=True, max_gaussians=5))
def test_screen_moments_are_the_oracles(backend, scene):
    _agree_on_moments(backend, screened(backend, scene))


def _opaque():
    """Return a scene whose front Gaussian is opaque over many pixels: its alpha is over every profile's ceiling."""
    camera = Camera(np.eye(4), np.array([[4.0, 0, 2.5], [0, 8.0, 2.0], [0, 0, 1]]), 5, 4)
    columns = [[[0.25, 0.0, 4.0], [0.0, 0.0, 5.0]], [[1.0, 0.0, 0.0, 0.0]] * 2, [[64.0] * 3, [1.0] * 3], [1.0, 0.5]]
    return Scene(Gaussians(*map(np.array, columns), np.array([[[1.0, 0.5, 0.25]], [[-1.0, 0.5, 1.0]]])), camera,
                 np.array([0.125, 0.25, 0.75]), INRIA)  # fmt: skip


@law(
    "fisher",
    "screen_moments",
    first=[{"scene": _opaque()}],
    scene=scenes(profile=INRIA, size=plain_sizes(), max_gaussians=4, max_side=16),
)
def test_screen_moments_of_inrias_profile_are_the_oracles(backend, scene):
    _agree_on_moments(backend, screened(backend, scene))


@law("fisher", "screen_moments", scene=scenes(anchored=True))
def test_who_is_blended_at_no_pixel_has_no_moments(backend, scene):
    given = screened(backend, scene)
    nowhere = given.sure & (contributions(*given.view, None, given.scene.profile).n_pixels == 0)
    found = _moments(backend, given)
    assert_same_bits("moments", found[nowhere], np.zeros((int(np.sum(nowhere)), 31)))
    assert np.all(found[:, [0, 5, 9, 12, 14, 30]] >= 0.0), "a square is never negative"


@law("fisher", "screen_moments", scene=plain, seed=st.randoms(use_true_random=False))
def test_moments_stay_with_their_rows(backend, scene, seed):
    given = screened(backend, scene)
    order = shuffled(seed, len(scene.gaussians))
    one, other = _moments(backend, given), _moments(backend, permuted(given, order))
    error_bound = moment_error_bounds(given.error_bounds, 0.5 * given.tile_size)[order]
    assert_close("fisher.rows", other, one[order], error_bound, backend.dtype)


def _second_moments(moments):
    """Return the six by six matrices of (q_c, w), one a channel. [N, 3, 6, 6]; that of q q^T counted thrice"""
    found = np.zeros((len(moments), 3, 6, 6))
    for k, (i, j) in enumerate(UPPER):
        found[:, :, i, j] = found[:, :, j, i] = moments[:, None, k]
    for c in range(3):
        found[:, c, :5, 5] = found[:, c, 5, :5] = moments[:, 15 + 5 * c : 20 + 5 * c]
        found[:, c, 5, 5] = moments[:, 30]
    return found


@law("fisher", "fisher_blocks", scene=shapely, first=[{"scene": Scene(gaussians(3, 2, 6), cameras(1)[0])}])
def test_fisher_blocks_are_the_oracles(backend, scene):
    given = screened(backend, scene)
    moments = screen_moments(*given.view, given.scene.background, given.scene.profile)
    moments = moments.astype(backend.dtype).astype(np.float64)
    # as many bands as there are, and the first alone
    for degree in (given.scene.sh_degree, 0):
        _assert_blocks(backend, given, dataclasses.replace(given.scene, sh_degree=degree), moments)


def _assert_blocks(backend, given, seen, moments):
    args = (seen.gaussians, seen.camera, moments, seen.sh_degree, seen.profile)
    expected, found = fisher_blocks(*args), backend.stage("fisher_blocks")(*args)
    assert np.any(expected != 0.0), "no block has anything in it"
    # twice the Jacobian times its error bound, about the absolute values of the moments
    J = parameter_error_bounds(seen, given.error_bounds.screen)
    seconds = np.abs(_second_moments(moments))
    error_bound = np.zeros((len(moments), 6, 6))
    for c in range(3):
        K = np.concatenate([J[:, :5], J[:, 5 + c : 6 + c]], axis=1)
        error_bound += np.swapaxes(K, 1, 2) @ seconds[:, c] @ K
    rows = ~given.error_bounds.screen.kinked & given.splats.visible
    assert_close(
        "agreement.fisher_blocks", found[rows], expected[rows], error_bound[rows], backend.dtype, against_oracle=True
    )


@law("fisher", "screen_moments", "fisher_blocks", scene=shapely)
def test_blocks_are_symmetric_and_no_direction_has_negative_information(backend, scene):
    given = screened(backend, scene)
    seen = given.scene
    blocks = backend.stage("fisher_blocks")(
        seen.gaussians, seen.camera, _moments(backend, given), seen.sh_degree, seen.profile
    )
    assert_same_bits("transposed", np.swapaxes(blocks, 1, 2), blocks)
    diagonals = np.diagonal(blocks, axis1=1, axis2=2)
    # of units that make every diagonal one, rounding may take a little from the least eigenvalue
    D = np.sqrt(np.where(diagonals > 0.0, diagonals, 1.0))
    assert np.all(diagonals >= 0.0)
    least = np.linalg.eigvalsh(blocks / D[:, :, None] / D[:, None, :])[:, :1]
    resolved = ~given.error_bounds.screen.kinked & given.splats.visible
    assert np.all(least[resolved] >= -(2.0**14) * np.finfo(backend.dtype).eps)
    assert np.all(blocks[~given.splats.visible] == 0.0)


@law("fisher", "fisher_blocks", scene=shapely)
def test_blocks_are_linear_in_the_moments(backend, scene):
    given = screened(backend, scene)
    seen, moments = given.scene, screen_moments(*given.view, given.scene.background, given.scene.profile)

    def blocks(of):
        return backend.stage("fisher_blocks")(seen.gaussians, seen.camera, of, seen.sh_degree, seen.profile)

    assert_same_bits("blocks of twice the moments", blocks(2.0 * moments), 2.0 * blocks(moments))


def _positive(rows):
    """Return blocks of full rank with conditions that any precision resolves. [2, 6, 6]"""
    return rows @ np.swapaxes(rows, 1, 2) + 2.0 * np.eye(6)


blocks = arrays_of((2, 6, 6)).map(_positive)


@law("fisher", "log_det_scores", blocks=blocks)
def test_a_score_is_the_logarithm_of_the_determinant(backend, blocks):
    expected = np.linalg.slogdet(blocks)[1]
    assert_close("fisher.log_det", backend.stage("log_det_scores")(blocks), expected, 200.0, backend.dtype)


@law("fisher", "log_det_scores", blocks=blocks, powers=st.tuples(*[st.integers(-20, 20)] * 6))
def test_units_of_the_parameters_shift_a_score_and_lose_none(backend, blocks, powers):
    units = 2.0 ** np.array(powers, dtype=np.float64)
    score = backend.stage("log_det_scores")
    shifted = score(blocks * np.outer(units, units))
    expected = score(blocks) + 2.0 * np.log(2.0) * sum(powers)
    assert_close("fisher.units", shifted, expected, 200.0 + 2.0 * float(np.sum(np.abs(powers))), backend.dtype)


@law("fisher", "log_det_scores", blocks=blocks, blind=st.integers(0, 5))
def test_a_gaussian_that_some_direction_does_not_show_scores_least(backend, blocks, blind):
    deficient = blocks.copy()
    deficient[0, blind] = deficient[0, :, blind] = 0.0
    # and one that is shown twice by the same
    deficient[1, blind] = deficient[1, blind - 1]
    deficient[1, :, blind] = deficient[1, :, blind - 1]
    scores = backend.stage("log_det_scores")(np.concatenate([deficient, np.zeros((1, 6, 6))]))
    assert np.all(scores == -np.inf)


vectors = arrays_of((3,), -4.0, 4.0)
rays = vectors.map(lambda d: d if np.any(d) else np.array([0.0, 0.0, 1.0]))
shapes = st.tuples(*[st.sampled_from([0.25, 0.5, 1.0, 2.0])] * 3).map(np.array)


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
