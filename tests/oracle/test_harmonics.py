"""Spherical harmonics against SciPy's, and orthonormal by quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import sph_harm_y

from pop_ref import harmonics

RNG = np.random.default_rng(8)
DIRS = RNG.normal(size=(40, 3))
UNITS = DIRS / np.linalg.norm(DIRS, axis=1, keepdims=True)


def real_harmonic(l: int, m: int, units: np.ndarray) -> np.ndarray:
    """Combine SciPy's complex harmonics (with their Condon-Shortley phase) into the real one of the code bases."""
    theta, phi = np.arccos(units[:, 2]), np.arctan2(units[:, 1], units[:, 0])
    complex_values = sph_harm_y(l, abs(m), theta, phi)
    if m == 0:
        return complex_values.real
    return math.sqrt(2.0) * (complex_values.imag if m < 0 else complex_values.real)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_that_of_scipy_in_order_and_sign(degree: int) -> None:
    basis = harmonics.sh_basis(UNITS, degree)
    want = [real_harmonic(l, m, UNITS) for l in range(degree + 1) for m in range(-l, l + 1)]
    assert basis.shape == (40, len(want))
    np.testing.assert_allclose(basis, np.stack(want, axis=1), atol=5e-15)


def test_the_constants_are_the_decimal_literals_that_the_code_bases_print() -> None:
    along_z = harmonics.sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)[0]
    np.testing.assert_allclose(along_z[[0, 2]], [0.28209479177387814, 0.4886025119029199], rtol=1e-15)
    diagonal = harmonics.sh_basis(np.array([[1.0, 1.0, 1.0]]), 3)[0]
    np.testing.assert_allclose(diagonal[4], 1.0925484305920792, rtol=1e-15)
    np.testing.assert_allclose(diagonal[[9, 10]], [-0.5900435899266435 * 2.0, 2.890611442640554], rtol=1e-15)
    np.testing.assert_allclose(diagonal[[11, 12]], [-0.4570457994644658 * 2.0, 0.3731763325901154 * -4.0], rtol=1e-15)


def test_the_basis_is_orthonormal_by_gauss_legendre_quadrature() -> None:
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    angles = 2.0 * np.pi * np.arange(16) / 16
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, angles, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    basis = harmonics.sh_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 3)
    weights = np.repeat(node_weights, 16) * 2.0 * np.pi / 16
    np.testing.assert_allclose((basis * weights[:, None]).T @ basis, np.eye(16), atol=1e-14)


def test_colors_are_the_sum_over_the_basis_plus_one_half_clamped_at_zero() -> None:
    sh = RNG.normal(size=(40, 16, 3))
    for degree in range(4):
        n_sh = (degree + 1) ** 2
        want = np.einsum("nk,nkc->nc", harmonics.sh_basis(UNITS, degree), sh[:, :n_sh]) + 0.5
        assert np.any(want < 0.0)
        got = harmonics.colors_from_sh(sh, DIRS, degree)
        np.testing.assert_allclose(got, np.maximum(want, 0.0), atol=1e-14)


def test_degree_zero_does_not_look_at_the_direction() -> None:
    sh = RNG.normal(size=(40, 1, 3))
    assert np.array_equal(harmonics.colors_from_sh(sh, DIRS, 0), harmonics.colors_from_sh(sh, -DIRS[::-1], 0))


def test_zero_high_bands_give_the_lower_degree_s_bits() -> None:
    sh = RNG.normal(size=(40, 16, 3))
    sh[:, 4:] = 0.0
    assert np.array_equal(harmonics.colors_from_sh(sh, DIRS, 3), harmonics.colors_from_sh(sh, DIRS, 1))


def test_bands_have_parity() -> None:
    here, there = harmonics.sh_basis(UNITS, 3), harmonics.sh_basis(-UNITS, 3)
    sign = np.concatenate([np.full(2 * l + 1, (-1.0) ** l) for l in range(4)])
    assert np.array_equal(there, here * sign)


def test_wrong_degrees_and_too_few_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="sh_degree is 4; it must be 0, 1, 2 or 3"):
        harmonics.sh_basis(UNITS, 4)
    with pytest.raises(ValueError, match="sh has 4 coefficients; sh_degree 2 needs 9"):
        harmonics.colors_from_sh(np.zeros((40, 4, 3)), DIRS, 2)
