"""Transposes of one splat at one pixel against differences."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, Profile, alpha
from tests.gradients.checks import assert_vjp_matches

MEAN, CONIC = np.array([2.0, 1.25]), np.array([1.0, 0.5, 2.0])


def test_sigma_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda mean, conic: alpha.sigma_at_pixel(mean.tolist(), conic.tolist(), 0.5, 0.5),
        lambda mean, conic, v: alpha.sigma_at_pixel_vjp(mean.tolist(), conic.tolist(), 0.5, 0.5, float(v)),
        [MEAN, CONIC],
    )


def test_falloff_transpose_matches_differences() -> None:
    assert_vjp_matches(
        lambda s: alpha.falloff(float(s)), lambda s, v: alpha.falloff_vjp(float(s), float(v)), [np.array(0.75)]
    )


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("sigma", [0.25, 2.0])
def test_alpha_transpose_matches_differences_between_floor_and_ceiling(sigma: float, profile: Profile) -> None:
    assert_vjp_matches(
        lambda s, o: alpha.alpha_from_sigma(float(s), float(o), profile)[0],
        lambda s, o, v: alpha.alpha_from_sigma_vjp(float(s), float(o), float(v), profile),
        [np.array(sigma), np.array(0.75)],
    )


def test_over_the_ceiling_paper_passes_nothing_and_inria_passes_all() -> None:
    assert alpha.alpha_from_sigma(0.0, 1.0, PAPER)[0] == PAPER.alpha_ceiling
    assert alpha.alpha_from_sigma_vjp(0.0, 1.0, 4.0, PAPER) == (0.0, 0.0)
    assert alpha.alpha_from_sigma(0.0, 1.0, INRIA)[0] == INRIA.alpha_ceiling
    assert alpha.alpha_from_sigma_vjp(0.0, 1.0, 4.0, INRIA) == (-4.0, 4.0)


def test_at_exactly_the_ceiling_the_derivative_from_below_is_used() -> None:
    half = Profile(**{**PAPER.__dict__, "alpha_ceiling": 0.5})
    assert alpha.alpha_from_sigma_vjp(0.0, 0.5, 4.0, half) == (-2.0, 4.0)


@pytest.mark.parametrize(("sigma", "opacity"), [(0.0, 1.0 / 256.0), (0.0, 0.0), (100.0, 1.0), (-1.0, 0.5)])
def test_a_skipped_splat_passes_exactly_nothing(sigma: float, opacity: float) -> None:
    assert alpha.alpha_from_sigma(sigma, opacity)[1]
    assert alpha.alpha_from_sigma_vjp(sigma, opacity, 1.0) == (0.0, 0.0)
