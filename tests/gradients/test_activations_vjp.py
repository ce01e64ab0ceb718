"""Transposes of the activations against differences."""

from __future__ import annotations

import numpy as np

from pop_ref import activations
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(1)


def test_scales_transpose_matches_differences() -> None:
    args = [RNG.normal(size=(4, 3))]
    assert_vjp_matches(activations.scales_from_log_scales, activations.scales_from_log_scales_vjp, args)


def test_opacities_transpose_matches_differences() -> None:
    args = [np.array([-9.0, -1.0, 0.0, 0.5, 9.0])]
    assert_vjp_matches(activations.opacities_from_logits, activations.opacities_from_logits_vjp, args)


def test_opacities_transpose_does_not_cancel_near_one() -> None:
    v = activations.opacities_from_logits_vjp(np.array([40.0]), np.ones(1))
    np.testing.assert_allclose(v, np.exp(-40.0), rtol=1e-12)


def test_unit_quaternions_transpose_matches_differences() -> None:
    args = [RNG.normal(size=(4, 4)) * np.array([[1.0], [1.0], [0.125], [8.0]])]
    assert_vjp_matches(activations.unit_quats_from_quats, activations.unit_quats_from_quats_vjp, args)


def test_unit_quaternions_gradient_is_orthogonal_to_the_quaternion() -> None:
    quats = RNG.normal(size=(6, 4))
    v = activations.unit_quats_from_quats_vjp(quats, RNG.normal(size=(6, 4)))
    assert np.linalg.norm(v) > 0.0
    np.testing.assert_allclose(np.sum(quats * v, axis=1), 0.0, atol=1e-14)
