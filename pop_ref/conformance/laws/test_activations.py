"""Laws of the activations: raw parameters to scales, opacities and unit quaternions."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, quats

logits = st.lists(st.floats(-16.0, 16.0, width=32), min_size=1, max_size=4)


@law("activations", "scales_from_log_scales", log_scales=arrays_of((2, 3), -8.0, 8.0))
def test_adding_to_log_scales_multiplies_scales(backend, log_scales):
    activate = backend.stage("scales_from_log_scales")
    grown = activate(log_scales + 1.0)
    expected = activate(log_scales) * np.e
    assert_close("activations.scales", grown, expected, expected * (np.abs(log_scales) + 2.0), backend.dtype)


@law("activations", "scales_from_log_scales", log_scales=arrays_of((2, 3), -8.0, 8.0))
def test_scales_are_positive_and_one_at_zero(backend, log_scales):
    activate = backend.stage("scales_from_log_scales")
    assert np.all(activate(log_scales) > 0.0)
    assert_same_bits("scales at log 0", activate(np.zeros((1, 3))), np.ones((1, 3)))


@law("activations", "opacities_from_logits", logits=logits)
def test_opposite_logits_give_opacities_that_sum_to_one(backend, logits):
    activate = backend.stage("opacities_from_logits")
    x = np.array(logits)
    total = activate(x) + activate(-x)
    assert_close("activations.opacities", total, np.ones_like(x), 1.0, backend.dtype)


@law("activations", "opacities_from_logits", logits=logits)
def test_opacities_rise_with_their_logits_and_stay_within_zero_and_one(backend, logits):
    activate = backend.stage("opacities_from_logits")
    x = np.array(logits)
    assert np.all(activate(x) >= 0.0)
    assert np.all(activate(x) <= 1.0)
    assert np.all(activate(x + 1.0) >= activate(x))
    odds = activate(np.array([0.0, np.log(3.0)]))
    assert_close("activations.opacities", odds, np.array([0.5, 0.75]), 2.0, backend.dtype)


@law("activations", "opacities_from_logits")
def test_extreme_logits_saturate_without_overflow(backend):
    opacities = backend.stage("opacities_from_logits")(np.array([-1e4, 1e4]))
    assert_same_bits("saturated opacities", opacities, np.array([0.0, 1.0]))


@law("activations", "opacities_from_logits_vjp", logit=st.sampled_from([0.0, 4.0, 12.0, 20.0, 30.0, 45.0]))
def test_the_slope_of_an_opacity_is_the_same_at_both_poles(backend, logit):
    # o (1 - o), which is no difference: what is all but opaque still learns
    x = np.array([logit, -logit])
    found = backend.stage("opacities_from_logits_vjp")(x, np.ones(2))
    fall = np.exp(-logit)
    expected = np.full(2, fall / (1.0 + fall) ** 2)
    assert_close("activations.slope", found, expected, expected * (logit + 2.0), backend.dtype)


@law("activations", "unit_quats_from_quats", quat=quats(), power=st.integers(-8, 8))
def test_unit_quaternions_have_norm_one_and_forget_a_power_of_two(backend, quat, power):
    normalise = backend.stage("unit_quats_from_quats")
    q = np.array([quat]).astype(backend.dtype).astype(np.float64)
    unit = normalise(q)
    assert_close("activations.norm", np.sum(unit**2), 1.0, 1.0, backend.dtype)
    assert_same_bits("unit quaternion of a multiple", normalise(q * 2.0**power), unit)
    assert np.sum(unit * q) > 0.0
