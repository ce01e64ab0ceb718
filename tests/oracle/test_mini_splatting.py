"""Mini-Splatting's importance by loops, and point sizes against scipy's neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from pop_ref import PAPER, render
from pop_ref.contributions import contributions
from pop_ref.mini_splatting import nearest_log_scales, samples_per_view, scene_importance, view_importance
from tests.oracle.by_definition import blended_pixels
from tests.oracle.scenes import camera, random_gaussians, tilted_camera


def shown(view):
    gaussians = random_gaussians(5, 12)
    drawn = render(gaussians, view)
    found = contributions(drawn.splats, drawn.tile_lists, view.width, view.height, 16)
    return drawn, found


@pytest.mark.parametrize("outdoor", [False, True])
def test_importance_is_that_of_every_pixels_list(outdoor: bool) -> None:
    views, want, ever = [], np.zeros(12), np.zeros(12, dtype=bool)
    for view in (camera(), tilted_camera(9, 7)):
        drawn, found = shown(view)
        views.append((found, drawn.dominant_counts))
        weights = [[T * a for blended in blended_pixels(drawn, 16, PAPER).values() for j, T, a in blended if j == i]
                   for i in range(12)]  # fmt: skip
        wins = [int(np.sum(drawn.dominant_ids == i)) for i in range(12)]
        for i in range(12):
            if not outdoor:
                want[i] += sum(weights[i])
            elif wins[i] > 0:
                want[i] += sum(weights[i]) / len(weights[i])
        ever |= np.array(wins) > 0
        alone = view_importance(found, drawn.dominant_counts, outdoor)
        for i in range(12):
            value = sum(weights[i]) / max(len(weights[i]), 1) if outdoor else sum(weights[i])
            assert alone[i] == (0.0 if outdoor and wins[i] == 0 else pytest.approx(value))
    want[~ever] = 0.0
    assert np.any(ever)
    assert not np.all(ever)
    np.testing.assert_allclose(scene_importance(views, outdoor), want, rtol=1e-12)


def test_importance_of_no_views_is_told() -> None:
    with pytest.raises(ValueError, match="there are no views"):
        scene_importance([], outdoor=True)


def test_samples_are_a_views_share_of_the_points_and_at_most_its_pixels() -> None:
    assert samples_per_view(185, 1237, 822) == 3_500_000 // 185
    assert samples_per_view(3, 8, 4, max_points=10) == 3
    assert samples_per_view(1, 8, 4) == 32
    with pytest.raises(ValueError, match="n_views is 0; it must be >= 1"):
        samples_per_view(0, 8, 4)


def test_sizes_are_the_root_mean_square_of_three_neighbours() -> None:
    points = np.random.default_rng(0).normal(size=(40, 3))
    points[7] = points[3]
    distances = cKDTree(points).query(points, k=4)[0][:, 1:]
    want = np.log(np.sqrt(np.mean(distances**2, axis=1)))
    np.testing.assert_allclose(nearest_log_scales(points), np.repeat(want[:, None], 3, axis=1), rtol=1e-12)


def test_coincident_points_get_the_bound_and_few_points_what_neighbours_they_have() -> None:
    bound = 0.5 * np.log(1e-7)
    assert np.all(nearest_log_scales(np.zeros((5, 3))) == bound)
    assert np.all(nearest_log_scales(np.zeros((1, 3))) == bound)
    assert nearest_log_scales(np.zeros((0, 3))).shape == (0, 3)
    two = nearest_log_scales(np.array([[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]))
    np.testing.assert_allclose(two, np.full((2, 3), np.log(4.0)))
