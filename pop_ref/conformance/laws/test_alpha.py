"""Laws of one splat at one pixel: exponent, falloff, alpha (D5, D6)."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close
from pop_ref.conformance.capabilities import DOUBLE
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import dyadic, opacities, reals
from pop_ref.constants import PROFILES

point = st.tuples(dyadic(-8.0, 8.0), dyadic(-8.0, 8.0))
conics = st.tuples(reals(0.125, 3.0, dull=1.0), dyadic(-0.875, 0.875), reals(0.125, 3.0, dull=1.0)).map(
    lambda c: (c[0], c[1] * math.sqrt(c[0] * c[2]), c[2])
)
profiles = st.sampled_from(sorted(PROFILES)).map(PROFILES.__getitem__)


def _seen(backend, numbers):
    return tuple(float(backend.dtype(x)) for x in numbers)


@law("alpha", "sigma_at_pixel", mean=point, conic=conics, pixel=point)
def test_the_exponent_is_half_the_squared_distance_in_the_conics_metric(backend, mean, conic, pixel):
    d = np.array(mean) - np.array(pixel)
    conic = A, B, C = _seen(backend, conic)
    sigma = backend.stage("sigma_at_pixel")(mean, conic, *pixel)
    expected = 0.5 * d @ np.array([[A, B], [B, C]]) @ d
    size = 0.5 * np.abs(d) @ np.abs([[A, B], [B, C]]) @ np.abs(d)
    assert_close("alpha.sigma", sigma, expected, size, backend.dtype)


@law("alpha", "sigma_at_pixel", mean=point, conic=conics, pixel=point, shift=point)
def test_the_exponent_depends_on_the_offset_only_and_not_on_its_sign(backend, mean, conic, pixel, shift):
    sigma, conic = backend.stage("sigma_at_pixel"), _seen(backend, conic)
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
    sigma, opacity = _seen(backend, (sigma, opacity))
    alpha, skipped = backend.stage("alpha_from_sigma")(sigma, opacity, profile)
    raw = opacity * math.exp(-sigma)
    expected = min(raw, profile.alpha_ceiling)
    assert_close("alpha.alpha", alpha, expected, raw * (1.0 + sigma), backend.dtype)
    if abs(raw - profile.alpha_floor) > 1e-5:
        assert skipped == (raw < profile.alpha_floor)


@law("alpha", "alpha_from_sigma", opacity=opacities(), sigma=reals(-8.0, -0.125))
def test_a_negative_exponent_is_skipped(backend, opacity, sigma):
    assert backend.stage("alpha_from_sigma")(sigma, opacity)[1]


@law("alpha", "alpha_from_sigma", DOUBLE, profile=profiles)
def test_the_floor_itself_is_blended_and_the_number_below_it_is_not(backend, profile):
    alpha_of = backend.stage("alpha_from_sigma")
    floor = profile.alpha_floor
    assert alpha_of(0.0, floor, profile) == (floor, False)
    assert alpha_of(0.0, float(np.nextafter(floor, 0.0)), profile)[1]
    assert alpha_of(0.0, 1.0, profile) == (profile.alpha_ceiling, False)


@law("alpha", "sigma_at_pixel", "sigma_at_pixel_vjp", mean=point, conic=conics, pixel=point)
def test_the_exponents_gradient_is_its_exact_change_for_a_quadratic(backend, mean, conic, pixel):
    # sigma is quadratic in the mean and linear in the conic: a central difference of any width is exact
    sigma, conic = backend.stage("sigma_at_pixel"), _seen(backend, conic)
    v_mean, v_conic = backend.stage("sigma_at_pixel_vjp")(mean, conic, *pixel, 1.0)
    d = np.abs(np.array(mean) - np.array(pixel)) + 1.0
    size = float(d @ np.abs([[conic[0], conic[1]], [conic[1], conic[2]]]) @ d) + 1.0
    for k in range(2):
        ends = [sigma(tuple(np.array(mean) + sign * np.eye(2)[k]), conic, *pixel) for sign in (1.0, -1.0)]
        assert_close("alpha.gradient", v_mean[k], 0.5 * (ends[0] - ends[1]), size, backend.dtype)
    for k in range(3):
        more = _seen(backend, np.array(conic) + np.eye(3)[k])
        change = (sigma(mean, more, *pixel) - sigma(mean, conic, *pixel)) / (more[k] - conic[k])
        assert_close("alpha.gradient", v_conic[k], change, 4.0 * size, backend.dtype)


@law("alpha", "falloff", "falloff_vjp", sigma=reals(0.0, 16.0), v=dyadic(-2.0, 2.0))
def test_the_falloffs_gradient_is_minus_itself(backend, sigma, v):
    falloff = backend.stage("falloff")(sigma)
    pulled = backend.stage("falloff_vjp")(sigma, v)
    assert_close("alpha.gradient", pulled, -v * falloff, abs(v) * falloff * (1.0 + sigma), backend.dtype)


@law(
    "alpha",
    "alpha_from_sigma",
    "alpha_from_sigma_vjp",
    first=[
        {"sigma": sigma, "opacity": opacity, "profile": profile}
        for profile in PROFILES.values()
        for sigma, opacity in ((0.0, 1.0), (0.0, 0.995), (5.0, 0.5), (1.0, 0.75))
    ],
    sigma=st.one_of(st.just(0.0), reals(0.0, 5.0)),
    opacity=st.one_of(st.sampled_from([0.995, 0.991, 0.998, 1.0]), opacities()),
    profile=profiles,
)
def test_alphas_gradient_stops_at_floor_and_ceiling_and_nowhere_else(backend, sigma, opacity, profile):
    # B3: over the ceiling "zero" passes nothing, "pass" passes all
    sigma, opacity = _seen(backend, (sigma, opacity))
    raw, falloff = opacity * math.exp(-sigma), math.exp(-sigma)
    assume(min(abs(raw / profile.alpha_floor - 1.0), abs(raw / profile.alpha_ceiling - 1.0)) > 1e-5)
    v_sigma, v_opacity = backend.stage("alpha_from_sigma_vjp")(sigma, opacity, 0.75, profile)
    over = raw > profile.alpha_ceiling and profile.ceiling_gradient == "zero"
    passes = 0.0 if raw < profile.alpha_floor or over else 0.75
    size = (1.0 + sigma) * falloff
    assert_close("alpha.gradient", v_sigma, -passes * raw, size, backend.dtype)
    assert_close("alpha.gradient", v_opacity, passes * falloff, size, backend.dtype)
