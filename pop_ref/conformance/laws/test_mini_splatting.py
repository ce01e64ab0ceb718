"""Laws of Mini-Splatting: importance over views, and sizes of points by their neighbours."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic
from pop_ref.contributions import Contributions

N = 4
row = st.tuples(dyadic(0.125, 8.0), st.integers(1, 9), st.integers(0, 3))
views = st.lists(st.lists(row, min_size=N, max_size=N), min_size=1, max_size=3)
points = arrays_of((6, 3), -8.0, 8.0)


def _view(rows):
    weights, pixels, wins = (np.array(column) for column in zip(*rows, strict=True))
    # the last row is seen nowhere
    weights[-1], pixels[-1], wins[-1] = 0.0, 0, 0
    return Contributions(weights, pixels, np.zeros(N), np.zeros(N)), np.minimum(wins, pixels)


@law("mini_splatting", "view_importance", view=views.map(lambda v: _view(v[0])))
def test_importance_is_weight_indoors_and_weight_a_pixel_for_who_dominates_outdoors(backend, view):
    found, wins = view
    importance = backend.stage("view_importance")
    assert_same_bits("indoors", importance(found, wins, False), found.weight_sum)
    outdoors = np.where(wins > 0, found.weight_sum / np.maximum(found.n_pixels, 1), 0.0)
    assert_close("mini_splatting.outdoors", importance(found, wins, True), outdoors, outdoors, backend.dtype)


@law("mini_splatting", "view_importance", "scene_importance", views=views, outdoor=st.booleans())
def test_importance_adds_over_views_and_is_none_where_no_pixel_is_dominated(backend, views, outdoor):
    shown = [_view(rows) for rows in views]
    found = backend.stage("scene_importance")(shown, outdoor)
    dominated = sum(wins for _, wins in shown) > 0
    added = sum(backend.stage("view_importance")(f, wins, outdoor) for f, wins in shown)
    assert_close("mini_splatting.sum", found[dominated], added[dominated], added[dominated], backend.dtype)
    assert_same_bits("never dominant", found[~dominated], np.zeros(int(np.sum(~dominated))))


@law(
    "mini_splatting",
    "samples_per_view",
    n_views=st.integers(1, 300),
    width=st.integers(1, 2000),
    height=st.integers(1, 2000),
    max_points=st.integers(0, 4_000_000),
)
def test_views_share_the_points_and_give_no_more_than_their_pixels(backend, n_views, width, height, max_points):
    found = int(backend.stage("samples_per_view")(n_views, width, height, max_points))
    assert found == min(int(max_points / n_views), width * height)


@law("mini_splatting", "nearest_log_scales", points=points)
def test_a_point_is_as_large_as_its_three_neighbours_are_far(backend, points):
    found = backend.stage("nearest_log_scales")(points)
    squared = np.sort(np.sum((points[:, None] - points[None]) ** 2, axis=2), axis=1)[:, 1:4]
    expected = 0.5 * np.log(np.maximum(np.mean(squared, axis=1), 1e-7))
    assert_close("mini_splatting.scales", found, np.repeat(expected[:, None], 3, 1), 20.0, backend.dtype)


@law("mini_splatting", "nearest_log_scales", points=points, count=st.integers(1, 3))
def test_of_fewer_than_four_points_the_mean_is_over_those_that_there_are(backend, points, count):
    found = backend.stage("nearest_log_scales")(points[:count])
    squared = np.sum((points[:count, None] - points[None, :count]) ** 2, axis=2)
    expected = 0.5 * np.log(np.maximum(np.sum(squared, axis=1) / max(count - 1, 1), 1e-7))
    assert_close("mini_splatting.scales", found, np.repeat(expected[:, None], 3, 1), 20.0, backend.dtype)


@law("mini_splatting", "nearest_log_scales", points=points, shift=arrays_of((3,), -4.0, 4.0))
def test_sizes_move_with_their_points_and_grow_with_the_scene(backend, points, shift):
    size = backend.stage("nearest_log_scales")
    once = size(points)
    assert_close("mini_splatting.scales", size(points + shift), once, 20.0, backend.dtype)
    apart = once[:, 0] > 0.5 * np.log(1e-7) + 1e-3
    assert_close("mini_splatting.scales", size(4.0 * points)[apart], once[apart] + np.log(4.0), 20.0, backend.dtype)
