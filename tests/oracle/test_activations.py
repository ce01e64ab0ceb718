"""Activations against closed forms and at the ends of their ranges."""

from __future__ import annotations

import math

import mpmath
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import activations


@given(st.floats(-700.0, 700.0))
def test_opacities_are_the_logistic_function_to_the_last_bits(logit: float) -> None:
    with mpmath.workdps(40):
        want = float(1 / (1 + mpmath.exp(-mpmath.mpf(logit))))
    np.testing.assert_allclose(activations.opacities_from_logits(np.array([logit]))[0], want, rtol=4e-16)


def test_opacities_never_overflow_and_reach_both_ends() -> None:
    got = activations.opacities_from_logits(np.array([-1e308, -800.0, 800.0, 1e308]))
    assert got.tolist() == [0.0, 0.0, 1.0, 1.0]


@given(st.floats(-20.0, 20.0))
def test_scales_are_exponentials(log_scale: float) -> None:
    got = activations.scales_from_log_scales(np.array([[log_scale] * 3]))
    np.testing.assert_allclose(got, math.exp(log_scale), rtol=4e-16)


lattice = st.integers(-4096, 4096).map(lambda k: k / 512.0)


@given(st.lists(lattice, min_size=4, max_size=4).filter(any), st.integers(-60, 60))
def test_unit_quaternions_have_norm_one_and_forget_a_power_of_two(quat: list[float], power: int) -> None:
    unit = activations.unit_quats_from_quats(np.array([quat]))
    np.testing.assert_allclose(np.linalg.norm(unit), 1.0, rtol=4e-16)
    scaled = activations.unit_quats_from_quats(np.array([quat]) * 2.0**power)
    assert np.array_equal(unit, scaled)


def test_quaternions_whose_squares_underflow_or_overflow_are_still_normalised() -> None:
    for size in (1e-200, 1e200):
        unit = activations.unit_quats_from_quats(np.array([[size, size, size, size]]))
        np.testing.assert_allclose(unit, 0.5, rtol=1e-15)
