"""Transposes of the splat's footprint against differences."""

from __future__ import annotations

import numpy as np

from pop_ref import footprint
from tests.gradients.checks import assert_vjp_matches

RNG = np.random.default_rng(6)
ROOTS = RNG.normal(size=(4, 2, 2))
COVARS2D = ROOTS @ ROOTS.swapaxes(1, 2) + 0.125 * np.eye(2)
FLAT = np.array([[[1.0, 2.0], [2.0, 1.0]]])


def test_low_pass_transpose_matches_differences() -> None:
    assert_vjp_matches(lambda c: footprint.low_pass(c, 0.3), lambda c, v: footprint.low_pass_vjp(c, 0.3, v), [COVARS2D])


def test_conics_transpose_matches_differences() -> None:
    assert_vjp_matches(footprint.conics_from_covars2d, footprint.conics_from_covars2d_vjp, [COVARS2D])


def test_compensations_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda c: footprint.compensations(c, 0.3), lambda c, v: footprint.compensations_vjp(c, 0.3, v), [COVARS2D]
    )


def test_both_cotangents_are_symmetric() -> None:
    for v in (
        footprint.conics_from_covars2d_vjp(COVARS2D, RNG.normal(size=(4, 3))),
        footprint.compensations_vjp(COVARS2D, 0.3, RNG.normal(size=4)),
    ):
        assert np.linalg.norm(v) > 0.0
        np.testing.assert_allclose(v, v.swapaxes(1, 2), rtol=1e-12)


def test_without_an_ellipse_nothing_passes() -> None:
    assert np.all(footprint.conics_from_covars2d_vjp(FLAT, np.ones((1, 3))) == 0.0)
    assert np.all(footprint.compensations_vjp(FLAT, 0.25, np.ones(1)) == 0.0)


def test_the_gradient_of_a_vanishing_footprint_in_antialiased_mode_is_finite() -> None:
    v = footprint.compensations_vjp(np.diag([0.0, 0.0])[None], 0.3, np.ones(1))
    assert np.all(v == 0.0)
