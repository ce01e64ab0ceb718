"""Transposes of rotations and covariances against differences."""

from __future__ import annotations

import numpy as np

from pop_ref import covariance
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(2)
QUATS = RNG.normal(size=(3, 4)) * np.array([[1.0], [0.25], [4.0]])
SCALES = np.exp(RNG.normal(size=(3, 3)))


def test_rotations_transpose_matches_differences() -> None:
    assert_vjp_matches(covariance.rotmats_from_quats, covariance.rotmats_from_quats_vjp, [QUATS])


def test_covariances_transpose_matches_differences() -> None:
    assert_vjp_matches(covariance.covars_from_quats_scales, covariance.covars_from_quats_scales_vjp, [QUATS, SCALES])


def test_quaternion_gradient_is_orthogonal_to_the_quaternion() -> None:
    v_quats, _ = covariance.covars_from_quats_scales_vjp(QUATS, SCALES, RNG.normal(size=(3, 3, 3)))
    assert np.linalg.norm(v_quats) > 0.0
    np.testing.assert_allclose(np.sum(QUATS * v_quats, axis=1), 0.0, atol=1e-13)


def test_a_zero_scale_has_a_zero_scale_gradient() -> None:
    scales = SCALES.copy()
    scales[1] = 0.0
    v_quats, v_scales = covariance.covars_from_quats_scales_vjp(QUATS, scales, RNG.normal(size=(3, 3, 3)))
    assert np.all(v_scales[1] == 0.0)
    assert np.all(v_quats[1] == 0.0)
    assert np.all(v_scales[[0, 2]] != 0.0)


def test_an_isotropic_covariance_does_not_depend_on_its_rotation() -> None:
    v_quats, _ = covariance.covars_from_quats_scales_vjp(QUATS, np.full((3, 3), 2.0), RNG.normal(size=(3, 3, 3)))
    np.testing.assert_allclose(v_quats, 0.0, atol=1e-12)
