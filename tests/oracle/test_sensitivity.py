"""Speedy-Splat's score against derivatives of single pixels, by the renderer's own transpose and by differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, SPEEDY_SPLAT, Profile, Splats, project, render
from pop_ref.compositing import composite, composite_vjp
from pop_ref.sensitivity import sensitivities
from pop_ref.tiles import tile_lists
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera

BACKGROUND = np.array([0.25, 0.5, 1.0])
SIZE = 4


def _falloff(splats: Splats, i: int, x: int, y: int) -> float:
    d = splats.means2d[i] - [x + 0.5, y + 0.5]
    A, B, C = splats.conics[i]
    return math.exp(-(0.5 * (A * d[0] ** 2 + C * d[1] ** 2) + B * d[0] * d[1]))


@pytest.mark.parametrize("profile", [PAPER, INRIA, SPEEDY_SPLAT], ids=lambda p: p.name)
@pytest.mark.parametrize("view", [camera(), tilted_camera()], ids=["straight", "tilted"])
def test_the_score_is_the_sum_of_squares_of_every_pixels_own_derivative(profile: Profile, view) -> None:
    gaussians = random_gaussians(3, 8)
    # bright enough for the ceiling, which the score ignores
    gaussians = replace(gaussians, opacities=np.where(np.arange(8) % 3 == 0, 1.0, gaussians.opacities))
    drawn = render(gaussians, view, profile=profile, tile_size=SIZE)
    splats, lists = drawn.splats, drawn.tile_lists
    through = replace(profile, ceiling_gradient="pass")
    want = np.zeros(len(gaussians))
    for y in range(view.height):
        for x in range(view.width):
            v_image = np.zeros((view.height, view.width, 3))
            v_image[y, x] = 1.0
            args = (splats, lists, view.width, view.height, SIZE, v_image)
            v_opacities = composite_vjp(*args, background=BACKGROUND, profile=through).v_opacities
            for i in np.flatnonzero(v_opacities).tolist():
                # dC/do = g dC/dalpha, and the score squares o dC/dalpha
                want[i] += (splats.opacities[i] * v_opacities[i] / _falloff(splats, i, x, y)) ** 2
    found = sensitivities(splats, lists, view.width, view.height, SIZE, BACKGROUND, profile)
    assert np.count_nonzero(want) >= 4
    np.testing.assert_allclose(found, want, rtol=1e-9)


def test_one_pixels_score_is_the_squared_difference_quotient() -> None:
    # two splats on one pixel, away from every threshold: o g moves with o alone
    gaussians = grey([0.5, 0.25], means=[[0.25, 0.0, 4.0], [0.0, 0.5, 5.0]])
    view = dyadic_camera(1, 1)
    splats = project(gaussians, view)
    lists = tile_lists(splats.means2d, splats.radii, splats.depths, 1, 1, 16)
    found = sensitivities(splats, lists, 1, 1, 16, BACKGROUND)
    for i in range(2):
        h, ends = 1e-6, []
        for sign in (1.0, -1.0):
            opacities = splats.opacities.copy()
            opacities[i] += sign * h
            moved = replace(splats, opacities=opacities)
            ends.append(np.sum(composite(moved, lists, 1, 1, 16, BACKGROUND).image))
        slope_of_alpha = (ends[0] - ends[1]) / (2.0 * h) / _falloff(splats, i, 0, 0)
        assert found[i] == pytest.approx((splats.opacities[i] * slope_of_alpha) ** 2, rel=1e-6)


def test_the_ceiling_is_not_differentiated_in_any_profile() -> None:
    splats = project(grey([1.0]), dyadic_camera(1, 1))
    # alpha is held at 0.999 there, and its gradient under "zero" would be none
    assert sensitivities(splats, [[0]], 1, 1, 16).tolist() == [pytest.approx(1.5**2)]


def test_channels_are_added_before_the_square() -> None:
    splats = replace(project(grey([0.5]), dyadic_camera(1, 1)), colors=np.array([[1.0, -1.0, 0.0]]))
    assert sensitivities(splats, [[0]], 1, 1, 16).tolist() == [0.0]
