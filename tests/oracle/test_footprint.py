"""The footprint: inverses, extents that miss nothing, culls at their edges, splats without an ellipse."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import INRIA, PAPER, footprint
from pop_ref.alpha import alpha_from_sigma, sigma_at_pixel

angles, stretches = st.floats(0.0, math.pi), st.floats(0.0, 6.0)
any_opacity = st.one_of(st.floats(0.0, 1.0), st.sampled_from([0.0, 1.0 / 256.0, PAPER.alpha_floor, 1.0]))


def covar2d(angle: float, a: float, b: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return footprint.low_pass((R @ np.diag([a * a, b * b]) @ R.T)[None], PAPER.eps2d)


@given(angles, stretches, stretches)
def test_conics_are_inverses(angle: float, a: float, b: float) -> None:
    covar = covar2d(angle, a, b)
    xx, xy, yy = footprint.conics_from_covars2d(covar)[0]
    np.testing.assert_allclose(covar[0] @ [[xx, xy], [xy, yy]], np.eye(2), atol=1e-11)


@given(angles, stretches, stretches)
def test_compensations_are_root_determinant_ratios(angle: float, a: float, b: float) -> None:
    blurred = covar2d(angle, a, b)
    raw = blurred - PAPER.eps2d * np.eye(2)
    got = footprint.compensations(raw, PAPER.eps2d)[0]
    ratio = np.prod(np.linalg.eigvalsh(raw[0]) / np.linalg.eigvalsh(blurred[0]))
    assert 0.0 <= got <= 1.0
    np.testing.assert_allclose(got**2, max(0.0, ratio), atol=1e-12)


@given(angles, stretches, stretches, any_opacity, st.floats(0.0, 2.0 * math.pi), st.floats(1.0, 1.5))
def test_no_point_outside_the_extent_reaches_the_alpha_floor(
    angle: float, a: float, b: float, opacity: float, towards: float, beyond: float
) -> None:
    covar = covar2d(angle, a, b)
    conic = footprint.conics_from_covars2d(covar)[0].tolist()
    r_x, r_y = footprint.radii_from_covars2d(covar, np.array([opacity]))[0].tolist()
    # a point on the rectangle's edge, or a little outside
    dx, dy = math.cos(towards), math.sin(towards)
    scale = min(r_x / abs(dx) if dx else math.inf, r_y / abs(dy) if dy else math.inf)
    sigma = sigma_at_pixel((0.0, 0.0), conic, beyond * scale * dx, beyond * scale * dy)
    alpha, skipped = alpha_from_sigma(sigma, opacity)
    assert skipped or alpha < PAPER.alpha_floor * (1.0 + 1e-12)


def test_the_extent_is_tight() -> None:
    # at o = 1 the ellipse alpha = 1/255 reaches sqrt(2 ln 255) = 3.329 standard deviations
    covar = np.diag([100.0**2, 10.0**2])[None]
    assert footprint.radii_from_covars2d(covar, np.array([1.0])).tolist() == [[333, 34]]
    assert footprint.radii_from_covars2d(covar, np.array([0.5])).tolist() == [[312, 32]]


def test_an_opacity_under_the_floor_has_no_extent_and_one_at_the_floor_a_zero_one() -> None:
    covars = np.tile(np.eye(2), (4, 1, 1))
    floor = PAPER.alpha_floor
    opacities = np.array([0.0, math.nextafter(floor, 0.0), floor, math.nextafter(floor, 1.0)])
    assert footprint.radii_from_covars2d(covars, opacities).tolist() == [[0, 0], [0, 0], [0, 0], [1, 1]]


def test_inria_s_extent_is_a_square_of_three_deviations_whatever_the_opacity() -> None:
    covars = np.stack([np.diag([16.0, 1.0]), np.diag([1.0, 16.0]), np.eye(2)])
    radii = footprint.radii_from_covars2d(covars, np.array([1.0, 0.0, 0.5]), INRIA)
    # the last is widened: sqrt(max(0.1, 0)) is added to the equal eigenvalues
    assert radii.tolist() == [[12, 12], [12, 12], [math.ceil(3.0 * math.sqrt(1.0 + math.sqrt(0.1)))] * 2]


def test_a_splat_without_an_ellipse_is_culled_in_every_profile() -> None:
    covars = np.array([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
    for profile in (PAPER, INRIA):
        assert np.all(footprint.radii_from_covars2d(covars, np.ones(3), profile) == 0)
    assert np.all(footprint.conics_from_covars2d(covars) == 0.0)
    assert np.all(footprint.compensations(covars, 0.25) == 0.0)


def test_a_needle_so_long_that_the_determinant_rounds_to_nothing_is_culled() -> None:
    needle = np.array([[[1e18, 1e18], [1e18, 1e18]]])
    blurred = footprint.low_pass(needle, PAPER.eps2d)
    assert np.array_equal(blurred, needle)
    assert np.all(footprint.radii_from_covars2d(blurred, np.ones(1)) == 0)


def test_a_huge_splat_s_extent_fits_an_int32() -> None:
    radii = footprint.radii_from_covars2d(np.diag([1e30, 1e30])[None], np.ones(1))
    assert radii.tolist() == [[2**31 - 1, 2**31 - 1]]


def test_a_splat_that_only_touches_the_image_s_border_is_off_screen() -> None:
    means2d = np.array([[-2.0, 1.0], [-1.75, 1.0], [10.0, 1.0], [9.75, 1.0], [4.0, -2.0], [4.0, 6.0], [4.0, 5.75]])
    radii = np.full((7, 2), 2)
    assert footprint.on_screen(means2d, radii, 8, 4).tolist() == [False, True, False, True, False, False, True]


def test_a_splat_without_extent_is_off_screen() -> None:
    assert footprint.on_screen(np.array([[1.0, 1.0]]), np.array([[0, 0]]), 4, 4).tolist() == [False]


def test_inria_keeps_a_splat_if_its_square_reaches_a_tile() -> None:
    # grid of 16 px over 20 px: the right tile ends at 32, and the square's start is kept under 32.5
    means2d = np.array([[34.25, 8.0], [34.5, 8.0], [-0.5, 8.0], [-0.75, 8.0]])
    radii = np.full((4, 2), 2)
    assert footprint.on_screen(means2d, radii, 20, 16, INRIA).tolist() == [True, False, True, False]
    assert footprint.on_screen(means2d, radii, 20, 16, replace(INRIA, tile_size=4)).tolist() == [
        False,
        False,
        True,
        False,
    ]
