"""Margins where numbers end: at the camera's centre, behind it, needles without an inverse, overflow."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, Profile, margins, render
from pop_ref.magnitudes import splat_magnitudes
from tests.oracle.scenes import dyadic_camera, grey, tilted_camera

EPS32 = 2.0**-24


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize(
    ("mean", "eye"), [([0.0] * 3, [0.0] * 3), ([0.0, 0.0, -3.0], [0.0] * 3), ([0.5, 0.25, -1.0], [0.5, 0.25, -1.0])]
)
def test_a_gaussian_at_or_behind_the_camera_is_surely_culled_and_leaves_the_others_alone(
    mean: list[float], eye: list[float], profile: Profile
) -> None:
    moved = np.eye(4)
    moved[:3, 3] = -np.array(eye)
    view = replace(dyadic_camera(3, 3), viewmat=moved)
    # a colour of degree 1 has a direction, and at the centre there is none
    both, alone = (
        margins(replace(grey([0.5] * n, means=means), sh=np.full((n, 4, 3), 0.25)), view, profile=profile)
        for n, means in ((2, [mean, [0.0, 0.0, 4.0]]), (1, [[0.0, 0.0, 4.0]]))
    )
    assert both.safe_gaussians(EPS32)[0]
    assert math.isinf(both.gaussians["B2"][0])
    for name, found in alone.gaussians.items():
        assert both.gaussians[name][1] == found[0]
    assert np.array_equal(both.safe_pixels(EPS32), alone.safe_pixels(EPS32))


def test_a_needle_whose_determinant_rounds_to_zero_is_in_doubt_in_antialiased_mode_too() -> None:
    # turned by 45 degrees its four entries are alike: the low-pass is lost in them
    turned = [[math.cos(math.pi / 8.0), 0.0, 0.0, math.sin(math.pi / 8.0)]]
    needle = replace(grey([0.5]), quats=np.array(turned), scales=np.array([[1e9, 0.0, 0.0]]))
    assert splat_magnitudes(needle, 0, dyadic_camera(5, 5), antialiased=True).det.value == 0.0
    assert not render(needle, dyadic_camera(5, 5), antialiased=True).splats.visible[0]
    got = margins(needle, dyadic_camera(5, 5), antialiased=True)
    assert got.gaussians["D2"][0] == 0.0
    assert not np.any(got.safe_pixels(EPS32))


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("power", [77, 154, 155, 300])
def test_of_a_gaussian_too_large_for_numbers_nothing_is_sure(power: int, profile: Profile, antialiased: bool) -> None:
    for view in (dyadic_camera(5, 5), tilted_camera()):
        for scales in ([1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]):
            huge = replace(grey([0.5]), scales=10.0**power * np.array([scales]), quats=np.array([[0.9, 0.1, 0.3, 0.2]]))
            with np.errstate(all="ignore"):
                image = render(huge, view, profile=profile, antialiased=antialiased)
                got = margins(huge, view, profile=profile, antialiased=antialiased)
            assert np.all(np.isfinite(image.image))
            assert not got.safe_gaussians(EPS32)[0]
            assert not np.any(got.safe_pixels(EPS32))
