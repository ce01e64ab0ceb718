"""One splat at one pixel: the quadratic form, and floor and ceiling at their edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import GSPLAT_1_6, INRIA, PAPER, Profile, alpha

# the kernels' 0.99
FLOAT32_99 = float(np.float32(0.99))

coordinates = st.integers(-64, 64).map(lambda k: k / 8.0)


@given(coordinates, coordinates, coordinates, coordinates, coordinates)
def test_sigma_is_half_the_quadratic_form(u: float, v: float, A: float, B: float, C: float) -> None:
    # eighths in, products of three eighths out: exact in float64
    d = np.array([u - 0.5, v - 1.5])
    want = 0.5 * float(d @ np.array([[A, B], [B, C]]) @ d)
    assert alpha.sigma_at_pixel((u, v), (A, B, C), 0.5, 1.5) == want


@given(st.floats(0.0, 700.0))
def test_falloff_is_the_exponential(sigma: float) -> None:
    assert alpha.falloff(sigma) == math.exp(-sigma)


@pytest.mark.parametrize(("profile", "ceiling"), [(PAPER, 0.999), (GSPLAT_1_6, FLOAT32_99), (INRIA, FLOAT32_99)])
def test_an_opaque_splat_stays_at_the_ceiling(profile: Profile, ceiling: float) -> None:
    assert alpha.alpha_from_sigma(0.0, 1.0, profile) == (ceiling, False)


def test_alpha_at_exactly_the_floor_takes_part_and_just_under_it_does_not() -> None:
    floor = 1.0 / 255.0
    assert alpha.alpha_from_sigma(0.0, floor) == (floor, False)
    assert alpha.alpha_from_sigma(0.0, math.nextafter(floor, 0.0))[1]


def test_a_negative_exponent_is_skipped_however_opaque() -> None:
    assert alpha.alpha_from_sigma(-1e-300, 1.0) == (0.0, True)
    assert alpha.alpha_from_sigma(-1e4, 1.0) == (0.0, True)


def test_opacity_zero_is_skipped() -> None:
    assert alpha.alpha_from_sigma(0.0, 0.0) == (0.0, True)
