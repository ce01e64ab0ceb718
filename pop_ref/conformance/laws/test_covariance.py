"""Laws of raw parameters, rotations and covariances: scales, opacities, unit quaternions, matrices."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, quats, reals

side = reals(0.0, 8.0, dull=1.0)
scales = st.tuples(side, side, side)

HALF = np.sqrt(0.5)
QUARTER_TURNS = {
    "x": ([HALF, HALF, 0.0, 0.0], [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "y": ([HALF, 0.0, HALF, 0.0], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "z": ([HALF, 0.0, 0.0, HALF], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


def _row(backend, values):
    return np.array([values]).astype(backend.dtype).astype(np.float64)


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=scales)
def test_a_quaternion_and_its_negative_give_identical_bits(backend, quat, scale):
    covars = backend.stage("covars_from_quats_scales")
    q, s = _row(backend, quat), _row(backend, scale)
    assert_same_bits("covariance of -q", covars(-q, s), covars(q, s))


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=scales, power=st.integers(-8, 8))
def test_a_power_of_two_times_a_quaternion_gives_identical_bits(backend, quat, scale, power):
    covars = backend.stage("covars_from_quats_scales")
    q, s = _row(backend, quat), _row(backend, scale)
    assert_same_bits("covariance of 2^k q", covars(q * 2.0**power, s), covars(q, s))


@law("covariance", "rotmats_from_quats")
def test_quarter_turns_about_the_axes_are_the_matrices_everyone_knows(backend):
    for quat, rotmat in QUARTER_TURNS.values():
        turned = backend.stage("rotmats_from_quats")(np.array([quat]))
        assert_close("covariance.rotation", turned[0], np.array(rotmat), 1.0, backend.dtype)


@law("covariance", "rotmats_from_quats", quat=quats())
def test_rotations_are_orthonormal_and_keep_handedness(backend, quat):
    R = backend.stage("rotmats_from_quats")(_row(backend, quat))[0]
    assert_close("covariance.rotation", R @ R.T, np.eye(3), 1.0, backend.dtype)
    assert_close("covariance.rotation", np.linalg.det(R), 1.0, 1.0, backend.dtype)


@law("covariance", "rotmats_from_quats", quat=quats())
def test_a_conjugate_quaternion_turns_back(backend, quat):
    rotmats = backend.stage("rotmats_from_quats")
    q = _row(backend, quat)
    back = rotmats(q * np.array([1.0, -1.0, -1.0, -1.0]))[0]
    assert_close("covariance.rotation", back, rotmats(q)[0].T, 1.0, backend.dtype)


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=scales)
def test_covariances_are_symmetric_with_the_squared_scales_as_eigenvalues(backend, quat, scale):
    s = _row(backend, scale)
    covar = backend.stage("covars_from_quats_scales")(_row(backend, quat), s)[0]
    assert_same_bits("transposed covariance", covar.T, covar)
    eigenvalues = np.linalg.eigvalsh(covar)
    assert_close("covariance.eigenvalues", eigenvalues, np.sort(s[0] ** 2), np.max(s) ** 2, backend.dtype)


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=side)
def test_an_isotropic_gaussian_ignores_its_rotation(backend, quat, scale):
    s = _row(backend, (scale,) * 3)
    covar = backend.stage("covars_from_quats_scales")(_row(backend, quat), s)[0]
    assert_close("covariance.isotropic", covar, s[0, 0] ** 2 * np.eye(3), s[0, 0] ** 2, backend.dtype)


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=scales)
def test_doubling_the_scales_quadruples_the_covariance_exactly(backend, quat, scale):
    covars = backend.stage("covars_from_quats_scales")
    q, s = _row(backend, quat), _row(backend, scale)
    assert_same_bits("covariance at 2 s", covars(q, 2.0 * s), 4.0 * covars(q, s))


@law("covariance", "covars_from_quats_scales", "rotmats_from_quats", quat=quats(), turn=quats(), scale=scales)
def test_a_world_rotation_conjugates_the_covariance(backend, quat, turn, scale):
    covars = backend.stage("covars_from_quats_scales")
    s = _row(backend, scale)
    q, r = np.array(quat), np.array(turn)
    R = backend.stage("rotmats_from_quats")(_row(backend, turn))[0]
    turned = covars(_row(backend, _hamilton(r, q) / np.linalg.norm(r)), s)[0]
    expected = R @ covars(_row(backend, quat), s)[0] @ R.T
    assert_close("covariance.conjugation", turned, expected, np.max(s) ** 2, backend.dtype)


@law("covariance", "covars_from_quats_scales", quat=quats(), scale=scales)
def test_turning_a_gaussian_about_its_own_axis_by_half_changes_nothing(backend, quat, scale):
    covars = backend.stage("covars_from_quats_scales")
    s = _row(backend, scale)
    half_turn = _hamilton(np.array(quat), np.array([0.0, 0.0, 0.0, 1.0]))
    same = covars(_row(backend, half_turn), s)
    assert_close("covariance.conjugation", same, covars(_row(backend, quat), s), np.max(s) ** 2, backend.dtype)


@law("covariance", "covars_from_quats_scales")
def test_scales_belong_to_the_gaussians_own_axes(backend):
    quarter_z = np.array([QUARTER_TURNS["z"][0]])
    covar = backend.stage("covars_from_quats_scales")(quarter_z, np.array([[1.0, 2.0, 4.0]]))[0]
    assert_close("covariance.isotropic", covar, np.diag([4.0, 1.0, 16.0]), 16.0, backend.dtype)


@law("covariance", "covars_from_quats_scales_vjp", quat=quats(), scale=scales, v=st.integers(1, 6))
def test_the_quaternion_gradient_is_orthogonal_to_the_quaternion(backend, quat, scale, v):
    q, s = _row(backend, quat), _row(backend, scale)
    v_covars = np.arange(9.0).reshape(1, 3, 3) * v - 4.0
    v_quats, _ = backend.stage("covars_from_quats_scales_vjp")(q, s, v_covars)
    size = np.max(np.abs(v_covars)) * np.max(s) ** 2
    assert_close("covariance.orthogonal", np.sum(q * v_quats), 0.0, size, backend.dtype)


def _hamilton(a, b):
    w, x, y, z = a
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]) @ b


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
