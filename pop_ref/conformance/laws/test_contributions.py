"""Laws of contributions: what a Gaussian adds to a view, summed over the pixels that blend it."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.compositing import composite, composite_vjp
from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.score_error_bounds import screened, weight_error_bounds
from pop_ref.conformance.strategies import faint_opacities, plain_sizes, scenes
from pop_ref.constants import INRIA
from pop_ref.contributions import contributions

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
    _agree(backend, screened(backend, scene))


@law("contributions", "contributions", scene=scenes(profile=INRIA, size=plain_sizes(), max_side=16))
def test_contributions_of_inrias_profile_are_the_oracles(backend, scene):
    _agree(backend, screened(backend, scene))


def _agree(backend, given):
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
