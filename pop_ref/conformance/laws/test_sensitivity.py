"""Laws of Speedy-Splat's score: the squared change of each pixel's summed colour with a splat's Gaussian."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.laws.test_contributions import permuted, plain, shuffled
from pop_ref.conformance.score_error_bounds import screened, sensitivity_error_bounds
from pop_ref.conformance.strategies import dyadic, plain_sizes, scenes
from pop_ref.constants import INRIA, PROFILES
from pop_ref.contributions import contributions
from pop_ref.records import Splats
from pop_ref.sensitivity import sensitivities


def _scored(backend, given, background=None):
    shown = given.scene.background if background is None else background
    return backend.stage("sensitivities")(*given.view, shown, given.scene.profile)


def _agree(backend, given):
    expected = sensitivities(*given.view, given.scene.background, given.scene.profile)
    rows, error_bound = given.sure, sensitivity_error_bounds(given.error_bounds)
    found = _scored(backend, given)
    assert_close(
        "agreement.sensitivity", found[rows], expected[rows], error_bound[rows], backend.dtype, against_oracle=True
    )


@law("sensitivity", "sensitivities", scene=scenes(anchored=True))
def test_sensitivities_are_the_oracles(backend, scene):
    _agree(backend, screened(backend, scene))


@law("sensitivity", "sensitivities", scene=scenes(profile=INRIA, size=plain_sizes(), max_side=16))
def test_sensitivities_of_inrias_profile_are_the_oracles(backend, scene):
    _agree(backend, screened(backend, scene))


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
