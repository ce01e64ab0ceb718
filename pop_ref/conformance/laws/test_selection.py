"""Laws of what methods choose by: a score, a share of the mass, or a draw.

Taming-3DGS has a budget, edges, and terms that are scaled to their medians; Mini-Splatting has importance over views,
and sizes of points by their neighbours.
"""

from __future__ import annotations

import math
import statistics
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic
from pop_ref.contributions import Contributions

scores = st.lists(dyadic(-4.0, 4.0), min_size=1, max_size=12).map(np.array)
masses = st.lists(dyadic(0.0, 64.0), min_size=1, max_size=12).map(np.array)
shares = st.sampled_from([0.5, 0.0, 1.0, 0.25, 0.75, 0.8125])
uniforms = st.lists(st.integers(0, 1023).map(lambda k: k / 1024.0), min_size=12, max_size=12).map(np.array)


@law("selection", "lowest_share", scores=scores, share=shares)
def test_the_lowest_go_up_to_the_score_at_the_share_of_the_last_index(backend, scores, share):
    gone = backend.stage("lowest_share")(scores, share)
    threshold = np.sort(scores)[int(share * (len(scores) - 1))]
    assert_same_bits("removed", gone, scores <= threshold)
    assert int(np.sum(gone)) >= int(share * (len(scores) - 1)) + 1


@law("selection", "lowest_share", n=st.integers(1, 12), share=shares, seed=st.randoms(use_true_random=False))
def test_of_distinct_scores_one_more_than_the_share_of_the_last_index_goes(backend, n, share, seed):
    values = [float(k) for k in range(n)]
    seed.shuffle(values)
    values[values.index(0.0)] = -math.inf
    gone = backend.stage("lowest_share")(np.array(values), share)
    assert int(np.sum(gone)) == int(share * (n - 1)) + 1
    assert gone[values.index(-math.inf)], "what has no information goes first"


@law("selection", "least_mass", masses=masses, share=shares)
def test_the_least_mass_goes_with_the_first_that_exceeds_the_share(backend, masses, share):
    gone = backend.stage("least_mass")(masses, share)
    ascending = np.sort(masses) + 1e-6
    held = np.cumsum(ascending) / np.sum(ascending)
    # a share that is met to the last place may be met on either side
    if np.min(np.abs(held - share)) > 2.0**-20:
        beyond = np.flatnonzero(held > share)
        bound = ascending[beyond[0]] if len(beyond) else np.inf
        assert_same_bits("removed", gone, masses <= bound)
    assert np.sum(masses[~gone]) <= (1.0 - share) * np.sum(masses) * (1.0 + 2.0**-20) + 1e-4


@law("selection", "lowest_share", "least_mass", masses=masses, share=shares, seed=st.randoms(use_true_random=False))
def test_who_is_removed_does_not_hang_on_the_order_of_rows(backend, masses, share, seed):
    order = list(range(len(masses)))
    seed.shuffle(order)
    for name in ("lowest_share", "least_mass"):
        remove = backend.stage(name)
        assert_same_bits(name, remove(masses[order], share), remove(masses, share)[order])


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms, k=st.integers(0, 12))
def test_a_draw_takes_the_first_arrivals_of_an_exponential_race(backend, masses, uniforms, k):
    u = uniforms[: len(masses)]
    draw = backend.stage("sample_without_replacement")
    if k > np.sum(masses > 0.0):
        with pytest.raises(ValueError, match=str(int(np.sum(masses > 0.0)))):
            draw(masses, k, u)
        return
    drawn = draw(masses, k, u)
    assert len(drawn) == k
    assert np.all(np.diff(drawn) > 0), "rows are given once each, ascending"
    assert np.all(masses[drawn] > 0.0), "what weighs nothing is never drawn"
    arrivals = np.array([-math.log1p(-p) / w if w > 0.0 else math.inf for p, w in zip(u, masses, strict=True)])
    last = np.max(arrivals[drawn], initial=-math.inf)
    left = np.delete(arrivals, drawn)
    assert np.all(left >= last * (1.0 - 2.0**-20)), "a Gaussian that was not drawn arrived before one that was"


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms)
def test_all_that_weighs_something_can_be_drawn(backend, masses, uniforms):
    positive = np.flatnonzero(masses > 0.0)
    drawn = backend.stage("sample_without_replacement")(masses, len(positive), uniforms[: len(masses)])
    assert_same_bits("drawn", drawn, positive)


@law("selection", "sample_without_replacement", masses=masses, uniforms=uniforms, k=st.integers(0, 12))
def test_a_draw_hangs_on_proportions_only(backend, masses, uniforms, k):
    k = min(k, int(np.sum(masses > 0.0)))
    draw = backend.stage("sample_without_replacement")
    u = uniforms[: len(masses)]
    assert_same_bits("drawn", draw(8.0 * masses, k, u), draw(masses, k, u))


counts = st.integers(0, 4_000_000)
photos = st.integers(0, 255).map(lambda k: _photo(k))
columns = st.lists(dyadic(-1.0, 8.0), min_size=1, max_size=9).map(np.array)


def _photo(seed):
    """Return a picture of 6 x 5 with flat parts, ramps and noise. uint8"""
    k = np.arange(90, dtype=np.int64).reshape(6, 5, 3)
    noise = np.mod(k * (2 * seed + 1) * 37 + k // 7 * seed, 251)
    return np.where(k % 4 < seed % 4, noise, 8 * (seed % 32)).astype(np.uint8)


@law("taming", "budget_at", n=st.integers(1, 145), start=counts, target=counts, data=st.integers(0, 145))
def test_the_budget_is_a_parabola_from_the_start_to_the_target(backend, n, start, target, data):
    budget = backend.stage("budget_at")
    assert int(budget(0, n, start, target)) == start
    assert int(budget(n, n, start, target)) == target
    x = min(data, n)
    exact = start + (target - start) * (1 - (1 - Fraction(x, n)) ** 2)
    assert int(budget(x, n, start, target)) == exact.__floor__()


@law("taming", "edge_map", photo=photos)
def test_edges_are_eight_times_the_grey_less_its_neighbours_and_the_frame_is_grey(backend, photo):
    grey = (photo.astype(np.int64) @ np.array([19595, 38470, 7471]) + 2**15) // 2**16
    expected = grey.astype(np.float64)
    for y in range(1, 5):
        for x in range(1, 4):
            around = sum(int(grey[y + j, x + i]) for i in (-1, 0, 1) for j in (-1, 0, 1)) - int(grey[y, x])
            expected[y, x] = min(max(8 * int(grey[y, x]) - around, 0), 255)
    assert_same_bits("edges", backend.stage("edge_map")(photo), expected)
    # a picture of two rows is all frame: eight thousand colours, some of which a rounded weight would turn
    colours = np.random.default_rng(1).integers(0, 256, (2, 4096, 3)).astype(np.uint8)
    grey = (colours.astype(np.int64) @ np.array([19595, 38470, 7471]) + 2**15) // 2**16
    assert_same_bits("grey", backend.stage("edge_map")(colours), grey.astype(np.float64))


KEPT = (np.arange(6)[:, None] + 2 * np.arange(5)) % 3 > 0


@law("taming", "pixel_weights", "edge_map", photo=photos, image=arrays_of((6, 5, 3), 0.0, 1.0))
def test_pixels_weigh_up_to_fifty_by_error_and_up_to_fifty_by_edge(backend, photo, image):
    weights = backend.stage("pixel_weights")(image, photo)
    error = np.mean(np.abs(image - photo / 255.0), axis=2)
    parts = [error, backend.stage("edge_map")(photo)]
    # a range that rounding made has no meaning
    expected = sum(50.0 * (x - x.min()) / np.ptp(x) if np.ptp(x) > 1e-3 else 0.0 * x for x in parts)
    if np.ptp(error) > 1e-3 or np.ptp(error) == 0.0:
        assert_close("taming.pixel_weights", weights, expected, 50.0 + 50.0 / max(np.ptp(error), 1e-3), backend.dtype)
    # what a mask leaves out weighs nothing, and stretches nothing: its error and its edges may be any
    other = image + np.where(KEPT, 0.0, 100.0)[..., None]
    masked = backend.stage("pixel_weights")(other, photo, KEPT)
    scaled = [(x - x[KEPT].min()) / np.ptp(x[KEPT]) if np.ptp(x[KEPT]) > 1e-3 else 0.0 * x for x in parts]
    expected = np.where(KEPT, 50.0 * sum(scaled), 0.0)
    if np.ptp(error[KEPT]) > 1e-3 or np.ptp(error[KEPT]) == 0.0:
        bound = 50.0 + 50.0 / max(np.ptp(error[KEPT]), 1e-3)
        assert_close("taming.pixel_weights", masked, expected, bound, backend.dtype)
    nothing = backend.stage("pixel_weights")(image, photo, np.zeros_like(KEPT))
    assert_same_bits("weights of no pixel", nothing, 0.0 * error)


@law("taming", "scaled_to_median", c=st.sampled_from([25.0, 0.125, 100.0]), x=columns)
def test_a_term_is_its_weight_at_the_lower_median_of_what_is_positive(backend, c, x):
    found = backend.stage("scaled_to_median")(c, x)
    positive = [v for v in x.tolist() if v > 0.0]
    expected = np.where(x > 0.0, c * x / statistics.median_low(positive or [1.0]), 0.0)
    assert_close("taming.median", found, expected, expected, backend.dtype)


@law("taming", "scaled_to_median", x=columns, power=st.integers(-8, 8))
def test_a_term_does_not_hang_on_its_unit(backend, x, power):
    scaled = backend.stage("scaled_to_median")
    assert_same_bits("term", scaled(25.0, x * 2.0**power), scaled(25.0, x))


ROWS = 6
NAMES = ("grads", "opacities", "depths", "distance_sum", "map_sum", "weight_sum")
WEIGHTS = {"grads": 25, "opacities": 100, "depths": 5, "distance_sum": 50, "map_sum": 10, "weight_sum": 50}
tables = st.fixed_dictionaries({name: arrays_of((ROWS,), 0.0, 8.0) for name in NAMES})


@law(
    "taming",
    "view_score",
    table=tables,
    scales=arrays_of((ROWS, 3), 0.125, 2.0),
    radii=st.lists(st.tuples(*[st.sampled_from([3, 0, 7, 40])] * 2), min_size=ROWS, max_size=ROWS).map(np.array),
    counts=st.lists(st.integers(0, 9), min_size=ROWS, max_size=ROWS).map(np.array),
    photometric=st.sampled_from([0.5, 0.125, 0.0]),
)
def test_a_views_score_is_nine_terms_and_nothing_for_what_it_does_not_show(
    backend, table, scales, radii, counts, photometric
):
    shown = np.all(radii > 0, axis=1)
    found = Contributions(table["weight_sum"], counts, table["map_sum"], table["distance_sum"])
    args = (table["grads"], table["opacities"], scales, table["depths"], radii, found)
    score = backend.stage("view_score")(photometric, *args)
    columns = {**table, "depths": np.where(shown, table["depths"], 0.0)}
    weighed = [(float(WEIGHTS[name]), column) for name, column in columns.items()]
    weighed += [(10.0, np.where(shown, np.max(radii, axis=1), 0.0)), (25.0, np.prod(scales, axis=1)), (0.1, counts)]
    expected = np.zeros(ROWS)
    for weight, column in weighed:
        positive = [v for v in np.asarray(column, dtype=np.float64).tolist() if v > 0.0]
        expected += weight * np.maximum(column, 0.0) / statistics.median_low(positive or [1.0])
    expected = np.where(shown, 50.0 * photometric * expected, 0.0)
    assert_close("taming.score", score, expected, expected, backend.dtype)
    assert_same_bits("what is not shown", score[~shown], np.zeros(int(np.sum(~shown))))


@law("taming", "quotas", budget=counts, n=counts, n_clone=st.integers(0, 10_000), n_split=st.integers(0, 10_000))
def test_quotas_share_what_the_budget_leaves_and_never_ask_for_less_than_none(backend, budget, n, n_clone, n_split):
    clone, split = (int(q) for q in backend.stage("quotas")(budget, n, n_clone, n_split))
    more = max(min(budget - n, n_clone + n_split), 0)
    of = max(n_clone + n_split, 1)
    assert (clone, split) == (more * n_clone // of, more * n_split // of)


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
    first=[{"n_views": 2, "width": 3, "height": 5, "max_points": 100}],
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
