"""Laws of spherical harmonics and colours."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.capabilities import ALL_BANDS, DOUBLE
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, reals

part = reals(-2.0, 2.0)
directions = st.tuples(part, part, part).filter(lambda d: sum(c * c for c in d) > 0.01)
degrees = st.integers(0, 3)
BANDS = [slice(0, 1), slice(1, 4), slice(4, 9), slice(9, 16)]


def _row(backend, values):
    return np.array([values]).astype(backend.dtype).astype(np.float64)


def _unit(backend, direction):
    d = np.array(direction)
    return _row(backend, d / np.linalg.norm(d))


@law("harmonics", "colors_from_sh", sh=arrays_of((1, 1, 3)), one=directions, other=directions)
def test_degree_zero_looks_the_same_from_everywhere(backend, sh, one, other):
    colors = backend.stage("colors_from_sh")
    assert_same_bits("colour", colors(sh, _row(backend, one), 0), colors(sh, _row(backend, other), 0))


@law("harmonics", "sh_basis", ALL_BANDS, direction=directions)
def test_each_band_has_the_energy_of_the_addition_theorem(backend, direction):
    basis = backend.stage("sh_basis")(_unit(backend, direction), 3)[0]
    for degree, band in enumerate(BANDS):
        expected = (2 * degree + 1) / (4.0 * np.pi)
        assert_close("harmonics.energy", np.sum(basis[band] ** 2), expected, expected, backend.dtype)


@law("harmonics", "sh_basis", ALL_BANDS, one=directions, other=directions)
def test_the_product_of_two_directions_depends_on_their_angle_only(backend, one, other):
    basis = backend.stage("sh_basis")
    a, b = _unit(backend, one), _unit(backend, other)
    x = float(a[0] @ b[0])
    legendre = [1.0, x, 1.5 * x * x - 0.5, 2.5 * x**3 - 1.5 * x]
    for degree, band in enumerate(BANDS):
        product = basis(a, 3)[0, band] @ basis(b, 3)[0, band]
        scale = (2 * degree + 1) / (4.0 * np.pi)
        assert_close("harmonics.energy", product, scale * legendre[degree], scale, backend.dtype)


@law("harmonics", "sh_basis", ALL_BANDS, direction=directions)
def test_odd_bands_flip_and_even_bands_keep_their_sign_in_the_opposite_direction(backend, direction):
    basis = backend.stage("sh_basis")
    d = _unit(backend, direction)
    here, there = basis(d, 3)[0], basis(-d, 3)[0]
    for degree, band in enumerate(BANDS):
        assert_same_bits(f"band {degree}", there[band], here[band] * (-1) ** degree)


@law("harmonics", "sh_basis")
def test_the_first_harmonics_are_minus_y_plus_z_minus_x(backend):
    basis = backend.stage("sh_basis")(np.eye(3), 1)
    c1 = np.sqrt(3.0 / (4.0 * np.pi))
    expected = np.array([[0.0, 0.0, -c1], [-c1, 0.0, 0.0], [0.0, c1, 0.0]])
    assert_close("harmonics.values", basis[:, 1:], expected, 1.0, backend.dtype)
    assert_close("harmonics.values", basis[:, 0], np.full(3, np.sqrt(0.25 / np.pi)), 1.0, backend.dtype)


@law("harmonics", "sh_basis", ALL_BANDS, direction=directions, degree=degrees)
def test_the_lower_bands_do_not_depend_on_the_degree_asked_for(backend, direction, degree):
    basis = backend.stage("sh_basis")
    d = _unit(backend, direction)
    n_sh = (degree + 1) ** 2
    assert_same_bits("basis", basis(d, degree), basis(d, 3)[:, :n_sh])


@law(
    "harmonics", "colors_from_sh", ALL_BANDS, sh=arrays_of((1, 16, 3), -1.0, 1.0), direction=directions, degree=degrees
)
def test_coefficients_beyond_the_degree_are_not_read(backend, sh, direction, degree):
    colors = backend.stage("colors_from_sh")
    n_sh = (degree + 1) ** 2
    d = _row(backend, direction)
    zeroed = sh.copy()
    zeroed[:, n_sh:] = 0.0
    assert_same_bits("colour", colors(sh, d, degree), colors(zeroed, d, degree))
    full = colors(zeroed, d, 3)
    size = 0.5 + np.sum(np.abs(sh), axis=1)
    assert_close("harmonics.colors", full, colors(sh, d, degree), size, backend.dtype)


@law("harmonics", "colors_from_sh", ALL_BANDS, sh=arrays_of((1, 16, 3), -0.125, 0.125), direction=directions)
def test_colours_are_linear_in_the_coefficients_where_they_are_not_clamped(backend, sh, direction):
    colors = backend.stage("colors_from_sh")
    d = _row(backend, direction)
    one, none = colors(sh, d, 3), colors(0.0 * sh, d, 3)
    half = colors(0.5 * sh, d, 3)
    unclamped = np.minimum(one, half) > 0.0
    assert_same_bits("colour without coefficients", none, np.full((1, 3), 0.5))
    size = 0.5 + np.sum(np.abs(sh), axis=1)
    expected = np.where(unclamped, 0.5 * (one + none), half)
    assert_close("harmonics.colors", half, expected, size, backend.dtype)


@law("harmonics", "colors_from_sh", "sh_basis", ALL_BANDS, sh=arrays_of((1, 16, 3), -1.0, 1.0), direction=directions)
def test_a_colour_is_one_half_plus_the_coefficients_on_the_basis_and_never_negative(backend, sh, direction):
    d = _row(backend, direction)
    basis = backend.stage("sh_basis")(_unit(backend, direction), 3)[0]
    expected = np.maximum(basis @ sh[0] + 0.5, 0.0)
    size = 0.5 + np.sum(np.abs(sh[0]), axis=0)
    colors = backend.stage("colors_from_sh")(sh, d, 3)[0]
    assert np.all(colors >= 0.0)
    assert_close("harmonics.colors", colors, expected, size, backend.dtype)


@law("harmonics", "colors_from_sh", ALL_BANDS, sh=arrays_of((1, 16, 3)), direction=directions, power=st.integers(-6, 6))
def test_the_length_of_a_view_direction_does_not_matter(backend, sh, direction, power):
    colors = backend.stage("colors_from_sh")
    d = _row(backend, direction)
    assert_same_bits("colour", colors(sh, d * 2.0**power, 3), colors(sh, d, 3))


@law("harmonics", "colors_from_sh_vjp", ALL_BANDS, sh=arrays_of((1, 16, 3)), direction=directions)
def test_a_clamped_colour_passes_no_gradient(backend, sh, direction):
    sh[0, 0] = -40.0
    v_sh, v_dirs = backend.stage("colors_from_sh_vjp")(sh, _row(backend, direction), 3, np.ones((1, 3)))
    assert_same_bits("v_sh", v_sh, np.zeros_like(v_sh))
    assert_same_bits("v_dirs", v_dirs, np.zeros_like(v_dirs))


@law("harmonics", "colors_from_sh_vjp", "sh_basis", ALL_BANDS, DOUBLE)
def test_a_colour_of_exactly_zero_learns(backend):
    # as black points have it when a training begins: the derivative from above, or they would stay black
    # in single precision no coefficient gives exactly 0 along an axis
    found = 0
    for axis in np.eye(3):
        basis = backend.stage("sh_basis")(axis[None], 3)[0]
        for band in np.flatnonzero(basis):
            for coefficient in _black(backend.dtype(basis[band])):
                sh = np.zeros((1, 16, 3))
                sh[0, band] = coefficient
                v_sh, _ = backend.stage("colors_from_sh_vjp")(sh, axis[None], 3, np.ones((1, 3)))
                assert_close("harmonics.values", v_sh[0], np.tile(basis[:, None], 3), 1.0, backend.dtype)
                found += 1
    assert found, "no coefficient gives exactly 0"


def _black(basis):
    """Yield coefficients that give 0 with the offset, and nothing under it if the product is not rounded before."""
    near = basis.dtype.type(-0.5) / basis
    for _ in range(4):
        exact = Fraction(float(basis)) * Fraction(float(near)) + Fraction(1, 2)
        if basis * near + basis.dtype.type(0.5) == 0.0 and exact >= 0:
            yield float(near)
        near = np.nextafter(near, basis.dtype.type(0.0))


@law("harmonics", "colors_from_sh_vjp", ALL_BANDS, sh=arrays_of((1, 16, 3)), direction=directions)
def test_the_gradient_to_a_direction_is_orthogonal_to_it(backend, sh, direction):
    d = _row(backend, direction)
    _, v_dirs = backend.stage("colors_from_sh_vjp")(sh, d, 3, np.ones((1, 3)))
    size = (1.0 + np.sum(np.abs(sh))) * 4.0
    assert_close("harmonics.orthogonal", np.sum(d * v_dirs), 0.0, size, backend.dtype)


@law(
    "harmonics",
    "lower_degree",
    sh=arrays_of((1, 4, 3), -1.0, 1.0),
    direction=directions,
    weight=st.sampled_from([0.0, 0.5, 1.0, 3.0]),
    uniform=st.sampled_from([0.25, 1.0, 2.0]),
)
def test_a_band_less_is_made_up_for_where_a_view_shows_it_by_its_weight(backend, sh, direction, weight, uniform):
    # of one view: the share w / (w + u) of what the dropped band showed it, in units of the first harmonic
    d = _row(backend, direction)
    x, y, z = d[0] / np.linalg.norm(d)
    dropped = np.sqrt(3.0) * (-y * sh[0, 1] + z * sh[0, 2] - x * sh[0, 3])
    found = backend.stage("lower_degree")(sh, d[None], np.array([[weight]]), 0, uniform)
    expected = sh[:, :1] + weight / (weight + uniform) * dropped
    size = 1.0 + np.sum(np.abs(sh), axis=1, keepdims=True)
    assert_close("harmonics.lower", found, expected, size, backend.dtype)
