"""Rotations and covariances against SciPy and their algebra."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_ref import covariance

# multiples of 1/1024, so that no square underflows where bits are compared
lattice = st.integers(-4096, 4096).map(lambda k: k / 1024.0)
quat_lists = st.lists(lattice, min_size=4, max_size=4).filter(any)
scale_lists = st.lists(lattice.map(abs), min_size=3, max_size=3)


@given(quat_lists)
def test_rotations_are_those_of_scipy(quat: list[float]) -> None:
    w, x, y, z = quat
    want = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(covariance.rotmats_from_quats(np.array([quat]))[0], want, atol=2e-15)


@given(quat_lists, scale_lists)
def test_covariances_are_symmetric_with_the_squared_scales_as_eigenvalues(
    quat: list[float], scales: list[float]
) -> None:
    covar = covariance.covars_from_quats_scales(np.array([quat]), np.array([scales]))[0]
    assert np.array_equal(covar, covar.T)
    want = np.sort(np.square(scales))
    np.testing.assert_allclose(np.linalg.eigvalsh(covar), want, atol=1e-13 * max(1.0, want[-1]))


@given(quat_lists, scale_lists)
def test_covariances_map_the_rotation_s_axes_to_their_variances(quat: list[float], scales: list[float]) -> None:
    w, x, y, z = quat
    covar = covariance.covars_from_quats_scales(np.array([quat]), np.array([scales]))[0]
    axes = Rotation.from_quat([x, y, z, w]).as_matrix()
    for k in range(3):
        np.testing.assert_allclose(covar @ axes[:, k], scales[k] ** 2 * axes[:, k], atol=1e-12)


@given(quat_lists, scale_lists)
def test_a_quaternion_and_its_negative_give_the_same_bits(quat: list[float], scales: list[float]) -> None:
    q, s = np.array([quat]), np.array([scales])
    assert np.array_equal(covariance.rotmats_from_quats(q), covariance.rotmats_from_quats(-q))
    assert np.array_equal(covariance.covars_from_quats_scales(q, s), covariance.covars_from_quats_scales(-q, s))


@given(quat_lists, scale_lists)
def test_doubling_the_scales_quadruples_the_covariance_exactly(quat: list[float], scales: list[float]) -> None:
    q, s = np.array([quat]), np.array([scales])
    once, twice = covariance.covars_from_quats_scales(q, s), covariance.covars_from_quats_scales(q, 2.0 * s)
    assert np.array_equal(twice, 4.0 * once)


def test_no_gaussians_have_no_covariances() -> None:
    assert covariance.covars_from_quats_scales(np.zeros((0, 4)), np.zeros((0, 3))).shape == (0, 3, 3)
