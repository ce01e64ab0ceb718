"""Contributions against lists of what each pixel blends, made from the definition."""

from __future__ import annotations

import numpy as np
import pytest

from pop_ref import INRIA, PAPER, SPEEDY_SPLAT, Profile, render
from pop_ref.contributions import contributions
from tests.oracle.by_definition import blended_pixels
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera

SIZE = 4


@pytest.mark.parametrize("profile", [PAPER, INRIA, SPEEDY_SPLAT], ids=lambda p: p.name)
@pytest.mark.parametrize("view", [camera(), tilted_camera(9, 7)], ids=["straight", "tilted"])
def test_the_sums_are_those_over_every_pixels_list(profile: Profile, view) -> None:
    gaussians = random_gaussians(5, 12)
    drawn = render(gaussians, view, profile=profile, tile_size=SIZE)
    shown = np.random.default_rng(0).uniform(size=drawn.T_final.shape)
    n = len(gaussians)
    weights, counts, of_map, distances = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for (x, y), blended in blended_pixels(drawn, SIZE, profile).items():
        for i, T, alpha in blended:
            weights[i] += T * alpha
            counts[i] += 1
            of_map[i] += shown[y, x]
            distances[i] += np.linalg.norm(np.array([x + 0.5, y + 0.5]) - drawn.splats.means2d[i])
    found = contributions(drawn.splats, drawn.tile_lists, view.width, view.height, SIZE, shown, profile)
    assert np.sum(counts) > 20
    assert found.n_pixels.tolist() == counts.tolist()
    for have, want in ((found.weight_sum, weights), (found.map_sum, of_map), (found.distance_sum, distances)):
        np.testing.assert_allclose(have, want, rtol=1e-12)


def test_without_a_map_its_sum_is_zero_and_a_terminating_splat_is_not_counted() -> None:
    # under 0.999 twice nothing would be left: the second ends the pixel and the third is never reached
    drawn = render(grey([1.0, 1.0, 0.5]), dyadic_camera(1, 1))
    found = contributions(drawn.splats, drawn.tile_lists, 1, 1, 16)
    assert found.n_pixels.tolist() == [1, 0, 0]
    assert found.weight_sum.tolist() == [PAPER.alpha_ceiling, 0.0, 0.0]
    assert found.map_sum.tolist() == [0.0, 0.0, 0.0]


def test_a_map_of_another_size_is_told() -> None:
    drawn = render(grey([0.5]), dyadic_camera(3, 2))
    with pytest.raises(ValueError, match=r"pixel_map has shape \[3, 2\]; it must be \[2, 3\]"):
        contributions(drawn.splats, drawn.tile_lists, 3, 2, 16, np.zeros((3, 2)))
