"""Transposes of the projection against differences, inside and outside the frustum clamp."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, Profile, projection
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(5)
K = np.array([[7.0, 0.0, 3.25], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]])
SIZE = (6, 5)
INSIDE = np.array([[0.5, -0.25, 2.0], [-1.0, 0.5, 4.0]])
# one clamped on each side: +x, -x, +y, -y, and both axes at once
OUTSIDE = np.array([[4.0, 0.5, 2.0], [-4.0, 0.5, 2.0], [0.5, 4.0, 2.0], [0.5, -4.0, 3.0], [-5.0, 6.0, 1.5]])


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
def test_centres_transpose_matches_differences(profile: Profile) -> None:
    assert_vjp_matches(
        lambda p: projection.project_means(p, K, *SIZE, profile),
        lambda p, v: projection.project_means_vjp(p, K, *SIZE, v, profile),
        [np.vstack([INSIDE, OUTSIDE])],
    )


@pytest.mark.parametrize("means_cam", [INSIDE, OUTSIDE], ids=["inside", "outside"])
def test_jacobians_transpose_matches_differences(means_cam: np.ndarray) -> None:
    assert_vjp_matches(
        lambda p: projection.projection_jacobians(p, K, *SIZE),
        lambda p, v: projection.projection_jacobians_vjp(p, K, *SIZE, v),
        [means_cam],
    )


def test_inria_s_jacobians_transpose_matches_differences_inside_the_frustum() -> None:
    assert_vjp_matches(
        lambda p: projection.projection_jacobians(p, K, *SIZE, INRIA),
        lambda p, v: projection.projection_jacobians_vjp(p, K, *SIZE, v, INRIA),
        [INSIDE],
    )


def test_inria_s_clamped_z_path_keeps_its_unclamped_form_and_its_x_path_is_cut() -> None:
    exact = Profile(**{**INRIA.__dict__, "clamp_gradient": "exact"})
    for x, y, z in OUTSIDE[:2].tolist():
        p, v_J = np.array([[x, y, z]]), np.zeros((1, 2, 3))
        v_J[0, 0, 2] = 1.0
        true = projection.projection_jacobians_vjp(p, K, *SIZE, v_J, exact)[0]
        inria = projection.projection_jacobians_vjp(p, K, *SIZE, v_J, INRIA)[0]
        tx = -projection.projection_jacobians(p, K, *SIZE, INRIA)[0, 0, 2] * z * z / K[0, 0]
        assert true[0] == inria[0] == 0.0
        np.testing.assert_allclose(inria[2], 2.0 * K[0, 0] * tx / z**3, rtol=1e-14)
        np.testing.assert_allclose(true[2], K[0, 0] * tx / z**3, rtol=1e-14)


def test_at_exactly_the_limit_the_derivative_from_inside_is_used() -> None:
    K4 = np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
    dyadic = Profile(**{**PAPER.__dict__, "frustum_margin": 0.5})
    # the limit is (W - cx) / fx + 0.5 W / (2 fx) = 0.5 + 0.25
    v_J = np.array([[[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]])
    v = projection.projection_jacobians_vjp(np.array([[1.5, 0.0, 2.0]]), K4, 4, 4, v_J, dyadic)
    assert v[0].tolist() == [-1.0, 0.0, 1.5]


def test_projected_covariances_transpose_matches_differences_for_matrices_that_are_not_symmetric() -> None:
    args = [RNG.normal(size=(3, 3, 3)), RNG.normal(size=(3, 2, 3))]
    assert_vjp_matches(projection.project_covars, projection.project_covars_vjp, args)
