"""The projection's Jacobian against mpmath and complex steps, its clamp at the limits, and EWA against samples."""

from __future__ import annotations

from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import INRIA, PAPER, projection
from tests.gradients.checks import complex_step_gradient

K = np.array([[7.0, 0.0, 3.25], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 6, 5

in_view = st.tuples(st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(0.5, 50.0))


@given(in_view)
def test_jacobians_are_the_pinhole_s_derivative_to_mpmath_s_digits(point: tuple[float, float, float]) -> None:
    slope_x, slope_y, z = point
    p = [slope_x * z, slope_y * z, z]
    with mpmath.workdps(40):
        pinhole = (lambda x, y, z: 7 * x / z, lambda x, y, z: 9 * y / z)
        orders = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
        want = [[float(mpmath.diff(f, tuple(map(mpmath.mpf, p)), n)) for n in orders] for f in pinhole]
    got = projection.projection_jacobians(np.array([p]), K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-18)


@given(in_view)
def test_jacobians_are_the_complex_step_derivative_of_the_projected_centres(point: tuple[float, float, float]) -> None:
    slope_x, slope_y, z = point
    p = np.array([slope_x * z, slope_y * z, z])
    rows = [
        complex_step_gradient(lambda q: K[0, 0] * q[0] / q[2] + K[0, 2], p),
        complex_step_gradient(lambda q: K[1, 1] * q[1] / q[2] + K[1, 2], p),
    ]
    np.testing.assert_allclose(
        projection.projection_jacobians(p[None], K, WIDTH, HEIGHT)[0], rows, rtol=1e-14, atol=1e-18
    )
    centre = projection.project_means(p[None], K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(centre, (K @ p)[:2] / p[2], rtol=1e-14)


@pytest.mark.parametrize(
    ("axis", "sign", "limit"),
    [
        (0, 1.0, (6 - 3.25) / 7.0 + 0.3 * 0.5 * 6 / 7.0),
        (0, -1.0, 3.25 / 7.0 + 0.3 * 0.5 * 6 / 7.0),
        (1, 1.0, (5 - 2.0) / 9.0 + 0.3 * 0.5 * 5 / 9.0),
        (1, -1.0, 2.0 / 9.0 + 0.3 * 0.5 * 5 / 9.0),
    ],
    ids=["+x", "-x", "+y", "-y"],
)
def test_the_clamp_holds_the_slope_at_its_limit_beyond_it_only(axis: int, sign: float, limit: float) -> None:
    for slope in (0.5 * limit, 0.999 * limit, 1.001 * limit, 40.0 * limit):
        p = np.array([[0.0, 0.0, 2.0]])
        p[0, axis] = sign * slope * 2.0
        got = projection.projection_jacobians(p, K, WIDTH, HEIGHT)[0]
        want = -sign * K[axis, axis] * min(slope, limit) / 2.0
        np.testing.assert_allclose(got[axis, 2], want, rtol=1e-14)
        assert got[1 - axis, 2] == 0.0
        assert got[axis, axis] == K[axis, axis] / 2.0


def test_inria_puts_the_principal_point_in_the_middle_for_centres_and_clamp() -> None:
    centred_K = K.copy()
    centred_K[:2, 2] = WIDTH / 2.0, HEIGHT / 2.0
    p = np.array([[0.5, 0.25, 2.0], [9.0, -9.0, 2.0]])
    used = replace(PAPER, principal_point="used")
    for f in (projection.project_means, projection.projection_jacobians):
        assert np.array_equal(f(p, K, WIDTH, HEIGHT, INRIA), f(p, centred_K, WIDTH, HEIGHT, used))
        assert not np.array_equal(f(p, K, WIDTH, HEIGHT, INRIA), f(p, K, WIDTH, HEIGHT, used))


def test_inria_s_limit_is_1_3_tangents_of_half_the_field_of_view() -> None:
    p = np.array([[100.0, 0.0, 1.0]])
    slope = -projection.projection_jacobians(p, K, WIDTH, HEIGHT, INRIA)[0, 0, 2] / K[0, 0]
    np.testing.assert_allclose(slope, 1.3 * (WIDTH / 2.0) / K[0, 0], rtol=1e-15)


def test_projected_covariances_are_those_of_projected_samples_of_a_small_gaussian() -> None:
    rng = np.random.default_rng(10)
    centre = np.array([0.4, -0.3, 3.0])
    root = rng.normal(size=(3, 3)) * 1e-5
    samples = rng.normal(size=(2000, 3))
    samples = (samples - samples.mean(axis=0)) @ root.T + centre
    seen = projection.project_means(samples, K, WIDTH, HEIGHT)
    covar = np.cov(samples.T)
    J = projection.projection_jacobians(centre[None], K, WIDTH, HEIGHT)
    np.testing.assert_allclose(projection.project_covars(covar[None], J)[0], np.cov(seen.T), rtol=1e-4)


def test_scaling_focal_and_image_scales_centres_once_and_covariances_twice() -> None:
    p, covar = np.array([[0.5, 0.25, 2.0], [9.0, -9.0, 2.0]]), np.eye(3)[None] * [[[1.0]], [[2.0]]]
    K2 = K.copy()
    K2[:2] *= 2.0
    once = projection.project_means(p, K, WIDTH, HEIGHT)
    assert np.array_equal(projection.project_means(p, K2, 2 * WIDTH, 2 * HEIGHT), 2.0 * once)
    J, J2 = (projection.projection_jacobians(p, k, s * WIDTH, s * HEIGHT) for k, s in ((K, 1), (K2, 2)))
    assert np.array_equal(projection.project_covars(covar, J2), 4.0 * projection.project_covars(covar, J))
