"""Taming-3DGS: the budget, Pillow's edges, the nine terms in a scalar loop, shares of the budget."""

from __future__ import annotations

import math
import statistics
from fractions import Fraction

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageFilter
from scipy.ndimage import correlate

from pop_ref import INRIA, PAPER, losses, render, taming
from pop_ref.contributions import Contributions, contributions
from tests.oracle.scenes import camera, random_gaussians, tilted_camera

counts = st.integers(0, 10**7)


@given(st.integers(1, 200), counts, counts)
def test_the_budget_starts_at_the_start_ends_at_the_target_and_never_turns(n: int, start: int, target: int) -> None:
    budgets = [taming.budget_at(x, n, start, target) for x in range(n + 1)]
    assert (budgets[0], budgets[-1]) == (start, target)
    steps = np.diff(budgets)
    assert np.all(steps >= 0) if target >= start else np.all(steps <= 0)


@given(st.integers(1, 200), st.data(), counts, counts)
def test_the_budget_is_the_parabola_rounded_down(n: int, data, start: int, target: int) -> None:
    x = data.draw(st.integers(0, n))
    parabola = start + (target - start) * (1 - (1 - Fraction(x, n)) ** 2)
    assert taming.budget_at(x, n, start, target) == math.floor(parabola)


def test_a_densification_outside_the_schedule_is_told() -> None:
    for nth, n in ((-1, 4), (5, 4), (0, 0)):
        with pytest.raises(ValueError, match=f"nth is {nth} of {n}"):
            taming.budget_at(nth, n, 10, 20)


@pytest.mark.parametrize("shape", [(7, 9), (3, 3), (2, 5), (1, 1), (12, 3)])
def test_edges_are_pillows(shape: tuple[int, int]) -> None:
    photo = np.random.default_rng(1).integers(0, 256, (*shape, 3)).astype(np.uint8)
    # smooth and flat parts too, where nothing is cut
    photo[: shape[0] // 2] //= 16
    theirs = np.asarray(Image.fromarray(photo).convert("L").filter(ImageFilter.FIND_EDGES))
    assert taming.edge_map(photo).tolist() == theirs.astype(np.float64).tolist()


def test_edges_inside_are_the_documented_kernels() -> None:
    photo = np.random.default_rng(2).integers(96, 128, (8, 6, 3)).astype(np.uint8)
    grey = np.asarray(Image.fromarray(photo).convert("L")).astype(np.float64)
    kernel = np.full((3, 3), -1.0)
    kernel[1, 1] = 8.0
    inside = np.s_[1:-1, 1:-1]
    for filtered in (correlate(grey, kernel), cv2.filter2D(grey, -1, kernel)):
        assert np.array_equal(taming.edge_map(photo)[inside], np.clip(filtered, 0.0, 255.0)[inside])
    edge = np.ones_like(grey, dtype=bool)
    edge[inside] = False
    assert np.array_equal(taming.edge_map(photo)[edge], grey[edge])


def test_what_is_no_photograph_is_told() -> None:
    with pytest.raises(ValueError, match=r"photo is float64 \[4, 4, 3\]; it must be uint8"):
        taming.edge_map(np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match=r"image has shape \[4, 5, 3\], photo \[4, 4, 3\]"):
        taming.pixel_weights(np.zeros((4, 5, 3)), np.zeros((4, 4, 3), dtype=np.uint8))


def test_pixels_weigh_by_error_and_edge_each_from_nothing_to_fifty() -> None:
    rng = np.random.default_rng(3)
    photo, image = rng.integers(0, 256, (6, 5, 3)).astype(np.uint8), rng.normal(size=(6, 5, 3))
    edges = np.asarray(Image.fromarray(photo).convert("L").filter(ImageFilter.FIND_EDGES)).astype(np.float64)
    error = np.abs(image - photo / 255.0).mean(axis=2)
    want = 50.0 * (error - error.min()) / np.ptp(error) + 50.0 * (edges - edges.min()) / np.ptp(edges)
    np.testing.assert_allclose(taming.pixel_weights(image, photo), want, rtol=1e-12)
    black = np.zeros((4, 4, 3), dtype=np.uint8)
    assert np.all(taming.pixel_weights(np.full((4, 4, 3), 0.5), black) == 0.0)
    # of an even grey picture the frame, which keeps its grey values, is all that is an edge
    framed = taming.pixel_weights(np.full((4, 4, 3), 0.5), black + np.uint8(51))
    assert np.all(framed[1:-1, 1:-1] == 0.0)
    assert np.all(framed[0] == 50.0)


@given(st.lists(st.floats(-2.0, 1e6), max_size=12), st.sampled_from([0.1, 25.0]))
def test_a_term_is_its_weight_at_the_lower_median(values: list[float], c: float) -> None:
    found = taming.scaled_to_median(c, np.array(values, dtype=np.float64))
    positive = [v for v in values if v > 0.0]
    median = statistics.median_low(positive) if positive else 1.0
    for value, term in zip(values, found.tolist(), strict=True):
        assert term == (pytest.approx(c * value / median) if value > 0.0 else 0.0)


def score_in_a_loop(photometric, grads, opacities, scales, depths, radii, found) -> list[float]:
    n = len(grads)
    seen = [min(radii[i]) > 0 for i in range(n)]
    columns = [
        (25.0, [grads[i] for i in range(n)]),
        (100.0, [opacities[i] for i in range(n)]),
        (5.0, [depths[i] if seen[i] else 0.0 for i in range(n)]),
        (10.0, [float(max(radii[i])) if seen[i] else 0.0 for i in range(n)]),
        (25.0, [scales[i][0] * scales[i][1] * scales[i][2] for i in range(n)]),
        (50.0, list(found.distance_sum)),
        (10.0, list(found.map_sum)),
        (0.1, [float(k) for k in found.n_pixels]),
        (50.0, list(found.weight_sum)),
    ]
    scores = []
    for i in range(n):
        total = 0.0
        for c, column in columns:
            positive = [x for x in column if x > 0.0]
            if column[i] > 0.0:
                total += c * column[i] / statistics.median_low(positive)
        scores.append(50.0 * photometric * total if seen[i] else 0.0)
    return scores


@pytest.mark.parametrize("seed", range(4))
def test_nine_terms_add_up_as_in_a_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 11
    gone = rng.uniform(size=n) < 0.3
    radii = np.where(gone[:, None], 0, rng.integers(1, 40, (n, 2)))
    sums = [np.where(gone, 0.0, rng.exponential(size=n)) for _ in range(3)]
    found = Contributions(sums[0], np.where(gone, 0, rng.integers(0, 9, n)), sums[1], sums[2])
    args = (
        0.125,
        np.maximum(rng.normal(size=n), 0.0),
        rng.uniform(size=n),
        rng.exponential(size=(n, 3)),
        rng.uniform(1.0, 9.0, n),
        radii,
        found,
    )
    np.testing.assert_allclose(taming.view_score(*args), score_in_a_loop(*args), rtol=1e-12)
    assert np.any(gone)
    assert np.all(taming.view_score(*args)[gone] == 0.0)


def test_scores_of_a_population_add_over_views_that_are_rendered_and_weighed() -> None:
    gaussians = random_gaussians(3, 9)
    rng = np.random.default_rng(0)
    views = [
        (v, rng.integers(0, 256, (v.height, v.width, 3)).astype(np.uint8)) for v in (camera(), tilted_camera(8, 9))
    ]
    grads, background = rng.exponential(size=9), np.array([0.0, 0.5, 1.0])
    for profile in (INRIA, PAPER):
        want = np.zeros(9)
        for view, photo in views:
            drawn = render(gaussians, view, background, 1, profile)
            target = photo / 255.0
            weights = taming.pixel_weights(drawn.image, photo)
            found = contributions(drawn.splats, drawn.tile_lists, view.width, view.height, 16, weights, profile)
            loss = 0.8 * np.mean(np.abs(drawn.image - target)) + 0.2 * losses.d_ssim(drawn.image, target, "same")
            shown = (drawn.splats.depths, drawn.splats.radii, found)
            want += score_in_a_loop(loss, grads, gaussians.opacities, gaussians.scales, *shown)
        assert np.count_nonzero(want) > 4
        np.testing.assert_allclose(
            taming.taming_scores(gaussians, views, grads, background, 1, profile), want, rtol=1e-10
        )


@given(counts, counts, st.integers(0, 10**6), st.integers(0, 10**6))
def test_quotas_share_what_the_budget_leaves(budget: int, n: int, n_clone: int, n_split: int) -> None:
    clone, split = taming.quotas(budget, n, n_clone, n_split)
    more = max(min(budget, n + n_clone + n_split) - n, 0)
    assert 0 <= clone <= n_clone
    assert 0 <= split <= n_split
    # rounded down twice, so that at most one is lost, and none where all are wanted
    assert more - 1 <= clone + split <= more
    if n_clone + n_split:
        assert clone == math.floor(Fraction(more * n_clone, n_clone + n_split))
    if budget >= n + n_clone + n_split:
        assert (clone, split) == (n_clone, n_split)
