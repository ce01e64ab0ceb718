"""Laws of one splat at one pixel: exponent, falloff, alpha (D5, D6)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.compare import assert_close
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import dyadic, opacities, reals
from pop_ref.constants import PROFILES

point = st.tuples(dyadic(-8.0, 8.0), dyadic(-8.0, 8.0))
conics = st.tuples(reals(0.125, 3.0, dull=1.0), dyadic(-0.875, 0.875), reals(0.125, 3.0, dull=1.0)).map(
    lambda c: (c[0], c[1] * math.sqrt(c[0] * c[2]), c[2])
)
profiles = st.sampled_from(sorted(PROFILES)).map(PROFILES.__getitem__)


@law("alpha", "sigma_at_pixel", mean=point, conic=conics, pixel=point)
def test_the_exponent_is_half_the_squared_distance_in_the_conics_metric(backend, mean, conic, pixel):
    d = np.array(mean) - np.array(pixel)
    A, B, C = conic
    sigma = backend.stage("sigma_at_pixel")(mean, conic, *pixel)
    expected = 0.5 * d @ np.array([[A, B], [B, C]]) @ d
    size = 0.5 * np.abs(d) @ np.abs([[A, B], [B, C]]) @ np.abs(d)
    assert_close("alpha.sigma", sigma, expected, size, backend.dtype)


@law("alpha", "sigma_at_pixel", mean=point, conic=conics, pixel=point, shift=point)
def test_the_exponent_depends_on_the_offset_only_and_not_on_its_sign(backend, mean, conic, pixel, shift):
    sigma = backend.stage("sigma_at_pixel")
    here = sigma(mean, conic, *pixel)
    moved = sigma((mean[0] + shift[0], mean[1] + shift[1]), conic, pixel[0] + shift[0], pixel[1] + shift[1])
    assert moved == here
    assert sigma(pixel, conic, *mean) == here
    assert sigma(mean, conic, *mean) == 0.0


@law("alpha", "falloff", sigma=reals(0.0, 16.0), more=reals(0.0, 8.0))
def test_the_falloff_is_one_at_the_centre_and_multiplies_over_sums(backend, sigma, more):
    falloff = backend.stage("falloff")
    assert falloff(0.0) == 1.0
    product = falloff(sigma) * falloff(more)
    assert_close("alpha.falloff", falloff(sigma + more), product, product * (4.0 + sigma + more), backend.dtype)
    assert_close("alpha.falloff", falloff(math.log(2.0)), 0.5, 1.0, backend.dtype)


@law("alpha", "alpha_from_sigma", sigma=reals(0.0, 8.0), opacity=opacities(), profile=profiles)
def test_alpha_is_the_falloff_times_opacity_between_the_floor_and_the_ceiling(backend, sigma, opacity, profile):
    # D5, D6
    alpha, skipped = backend.stage("alpha_from_sigma")(sigma, opacity, profile)
    raw = opacity * math.exp(-sigma)
    expected = min(raw, profile.alpha_ceiling)
    assert_close("alpha.alpha", alpha, expected, raw * (1.0 + sigma), backend.dtype)
    if abs(raw - profile.alpha_floor) > 1e-5:
        assert skipped == (raw < profile.alpha_floor)


@law("alpha", "alpha_from_sigma", opacity=opacities(), sigma=reals(-8.0, -0.125))
def test_a_negative_exponent_is_skipped(backend, opacity, sigma):
    assert backend.stage("alpha_from_sigma")(sigma, opacity)[1]


@law("alpha", "alpha_from_sigma", profile=profiles)
def test_the_floor_itself_is_blended_and_the_number_below_it_is_not(backend, profile):
    alpha_of = backend.stage("alpha_from_sigma")
    floor = profile.alpha_floor
    assert alpha_of(0.0, floor, profile) == (floor, False)
    assert alpha_of(0.0, float(np.nextafter(floor, 0.0)), profile)[1]
    assert alpha_of(0.0, 1.0, profile) == (profile.alpha_ceiling, False)
