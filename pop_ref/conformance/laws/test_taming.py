"""Laws of Taming-3DGS: the budget's parabola, edges, and terms that are scaled to their medians."""

from __future__ import annotations

import statistics
from fractions import Fraction

import numpy as np
from hypothesis import strategies as st

from pop_ref.conformance.assertions import assert_close, assert_same_bits
from pop_ref.conformance.law import law
from pop_ref.conformance.strategies import arrays_of, dyadic
from pop_ref.contributions import Contributions

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


@law("taming", "pixel_weights", "edge_map", photo=photos, image=arrays_of((6, 5, 3), 0.0, 1.0))
def test_pixels_weigh_up_to_fifty_by_error_and_up_to_fifty_by_edge(backend, photo, image):
    weights = backend.stage("pixel_weights")(image, photo)
    error = np.mean(np.abs(image - photo / 255.0), axis=2)
    parts = [error, backend.stage("edge_map")(photo)]
    # a range that rounding made has no meaning
    expected = sum(50.0 * (x - x.min()) / np.ptp(x) if np.ptp(x) > 1e-3 else 0.0 * x for x in parts)
    if np.ptp(error) > 1e-3 or np.ptp(error) == 0.0:
        assert_close("taming.pixel_weights", weights, expected, 50.0 + 50.0 / max(np.ptp(error), 1e-3), backend.dtype)


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


N = 6
NAMES = ("grads", "opacities", "depths", "distance_sum", "map_sum", "weight_sum")
WEIGHTS = {"grads": 25, "opacities": 100, "depths": 5, "distance_sum": 50, "map_sum": 10, "weight_sum": 50}
tables = st.fixed_dictionaries({name: arrays_of((N,), 0.0, 8.0) for name in NAMES})


@law(
    "taming",
    "view_score",
    table=tables,
    scales=arrays_of((N, 3), 0.125, 2.0),
    radii=st.lists(st.tuples(*[st.sampled_from([3, 0, 7, 40])] * 2), min_size=N, max_size=N).map(np.array),
    counts=st.lists(st.integers(0, 9), min_size=N, max_size=N).map(np.array),
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
    expected = np.zeros(N)
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
