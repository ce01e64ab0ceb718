"""Single stages of the projection against mpmath and SciPy, and at the ends of their domains."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from pop_ref import INRIA, PAPER, activations, covariance, footprint, harmonics, projection

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
    centre = projection.project_means(np.array([p]), K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(centre, (K @ p)[:2] / z, rtol=1e-14)


@given(st.floats(-700.0, 700.0))
def test_opacities_are_the_logistic_function_to_the_last_bits(logit: float) -> None:
    with mpmath.workdps(40):
        want = float(1 / (1 + mpmath.exp(-mpmath.mpf(logit))))
    np.testing.assert_allclose(activations.opacities_from_logits(np.array([logit]))[0], want, rtol=4e-16)


@given(st.floats(-20.0, 20.0))
def test_scales_are_exponentials(log_scale: float) -> None:
    got = activations.scales_from_log_scales(np.array([[log_scale] * 3]))
    np.testing.assert_allclose(got, math.exp(log_scale), rtol=4e-16)


def test_quaternions_whose_squares_underflow_or_overflow_are_still_normalised() -> None:
    for size in (1e-200, 1e200):
        unit = activations.unit_quats_from_quats(np.array([[size, size, size, size]]))
        np.testing.assert_allclose(unit, 0.5, rtol=1e-15)


# multiples of 1/1024, so that no square underflows where bits are compared
covariance_lattice = st.integers(-4096, 4096).map(lambda k: k / 1024.0)
quat_lists = st.lists(covariance_lattice, min_size=4, max_size=4).filter(any)


@given(quat_lists)
def test_rotations_are_those_of_scipy(quat: list[float]) -> None:
    w, x, y, z = quat
    want = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(covariance.rotmats_from_quats(np.array([quat]))[0], want, atol=2e-15)


def test_an_opacity_under_the_floor_has_no_extent_and_one_at_the_floor_a_zero_one() -> None:
    covars = np.tile(np.eye(2), (4, 1, 1))
    floor = PAPER.alpha_floor
    opacities = np.array([0.0, math.nextafter(floor, 0.0), floor, math.nextafter(floor, 1.0)])
    assert footprint.radii_from_covars2d(covars, opacities).tolist() == [[0, 0], [0, 0], [0, 0], [1, 1]]


def test_a_splat_without_an_ellipse_is_culled_and_so_is_a_needle_whose_determinant_rounds_to_nothing() -> None:
    covars = np.array([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
    assert np.all(footprint.compensations(covars, 0.25) == 0.0)
    needle = np.full((1, 2, 2), 1e18)
    blurred = footprint.low_pass(needle, PAPER.eps2d)
    assert np.array_equal(blurred, needle)
    for profile in (PAPER, INRIA):
        assert np.all(footprint.radii_from_covars2d(blurred, np.ones(1), profile) == 0)
        assert np.all(footprint.radii_from_covars2d(covars[2:], np.ones(1), profile) == 0)


def test_a_huge_splat_s_extent_fits_an_int32() -> None:
    radii = footprint.radii_from_covars2d(np.diag([1e30, 1e30])[None], np.ones(1))
    assert radii.tolist() == [[2**31 - 1, 2**31 - 1]]


HARMONICS_RNG = np.random.default_rng(8)
DIRS = HARMONICS_RNG.normal(size=(40, 3))
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


def test_a_lower_degree_loses_least_where_views_show_it_and_little_elsewhere() -> None:
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, 2.0 * np.pi * np.arange(16) / 16, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    sphere = harmonics.sh_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 3)
    shares = np.repeat(node_weights, 16) / 32.0
    sh, dirs = HARMONICS_RNG.normal(size=(6, 16, 3)), HARMONICS_RNG.normal(size=(5, 6, 3))
    weights = HARMONICS_RNG.uniform(0.0, 4.0, size=(5, 6))
    weights[:, 5] = 0.0
    shown = [harmonics.sh_basis(view / np.linalg.norm(view, axis=1, keepdims=True), 3) for view in dirs]

    def loss(lower: np.ndarray, i: int) -> float:
        change = sh[i].copy()
        change[: len(lower)] -= lower
        seen = sum(w[i] * ((basis[i] @ change) ** 2).sum() for w, basis in zip(weights, shown, strict=True))
        return float(seen + 2.0 * (shares @ (sphere @ change) ** 2).sum())

    for degree in range(4):
        lower = harmonics.lower_degree(sh, dirs, weights, degree, uniform=2.0)
        # seen by no view: cut off
        np.testing.assert_allclose(lower[5], sh[5, : (degree + 1) ** 2], rtol=1e-15)
        for i in range(6):
            least = loss(lower[i], i)
            for _ in range(5):
                step = 1e-3 * HARMONICS_RNG.normal(size=lower[i].shape)
                # a quadratic is as much higher on one side of its minimum as on the other
                higher = [loss(lower[i] + sign * step, i) - least for sign in (-1.0, 1.0)]
                assert min(higher) > 0.0
                assert higher[0] == pytest.approx(higher[1], rel=1e-6)
    np.testing.assert_allclose(harmonics.lower_degree(sh, dirs, weights, 3), sh, rtol=1e-15)


def test_wrong_degrees_and_too_few_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="sh_degree is 4; it must be 0, 1, 2 or 3"):
        harmonics.sh_basis(UNITS, 4)
    with pytest.raises(ValueError, match="sh has 4 coefficients; sh_degree 2 needs 9"):
        harmonics.colors_from_sh(np.zeros((40, 4, 3)), DIRS, 2)
