"""Taming-3DGS: the budget, Pillow's edges, the nine terms in a scalar loop, shares of the budget."""

from __future__ import annotations

import itertools
import math
import statistics
from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageFilter
from scipy.ndimage import correlate
from scipy.spatial import cKDTree

from pop_ref import (
    INRIA,
    PAPER,
    SPEEDY_SPLAT,
    Camera,
    Gaussians,
    Profile,
    Splats,
    losses,
    project,
    render,
    render_vjp,
    taming,
)
from pop_ref.compositing import composite, composite_vjp
from pop_ref.contributions import Contributions, contributions
from pop_ref.fisher import fisher_blocks, log_det_scores, screen_moments
from pop_ref.mini_splatting import nearest_log_scales, samples_per_view, scene_importance, view_importance
from pop_ref.selection import least_mass, lowest_share, sample_without_replacement
from pop_ref.sensitivity import sensitivities
from pop_ref.tiles import tile_lists
from tests.oracle.dense import blended_pixels
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera

counts = st.integers(0, 10**7)


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


# Selection: counts by the rule, draws against exact probabilities of small cases.

shares = st.one_of(st.sampled_from([0.0, 1.0, 0.5, 0.8, 0.3]), st.floats(0.0, 1.0))


def test_ties_at_the_threshold_all_go_and_minus_infinity_goes_first() -> None:
    scores = np.array([2.0, -np.inf, 2.0, 2.0, 5.0])
    assert lowest_share(scores, 0.25).tolist() == [True, True, True, True, False]
    assert lowest_share(scores, 0.0).tolist() == [False, True, False, False, False]
    assert lowest_share(np.zeros(0), 0.8).shape == (0,)


def test_what_cannot_be_sorted_is_told() -> None:
    with pytest.raises(ValueError, match=r"scores\[1\] is nan; scores must be numbers"):
        lowest_share(np.array([0.0, np.nan]), 0.5)
    with pytest.raises(ValueError, match=r"share is 1.5; it must be in \[0, 1\]"):
        lowest_share(np.zeros(2), 1.5)
    with pytest.raises(ValueError, match=r"share is -0.5"):
        least_mass(np.zeros(2), -0.5)
    with pytest.raises(ValueError, match=r"importance\[0\] is -1.0; it must be >= 0 and finite"):
        least_mass(np.array([-1.0, 1.0]))


def test_a_hundredth_of_the_mass_is_dropped_and_no_more_than_one_row_beyond_it() -> None:
    importance = np.random.default_rng(0).exponential(size=4000) ** 3
    gone = least_mass(importance)
    assert np.sum(importance[gone]) >= 0.01 * np.sum(importance)
    assert np.sum(np.sort(importance[gone])[:-1]) <= 0.01 * np.sum(importance)


def test_all_the_mass_is_all_rows() -> None:
    assert least_mass(np.array([1.0, 2.0]), 1.0).tolist() == [True, True]


def exact_probabilities(weights: list[float], k: int) -> dict[tuple[int, ...], float]:
    """Add over all orders the probability to draw these rows one after the other."""
    found: dict[tuple[int, ...], float] = {}
    positive = [i for i, w in enumerate(weights) if w > 0.0]
    for order in itertools.permutations(positive, k):
        p, left = 1.0, sum(weights)
        for i in order:
            p *= weights[i] / left
            left -= weights[i]
        key = tuple(sorted(order))
        found[key] = found.get(key, 0.0) + p
    return found


@pytest.mark.parametrize(("weights", "k"), [([1.0, 2.0, 4.0], 1), ([1.0, 0.0, 2.0, 5.0], 2), ([0.5, 3, 1, 1, 2], 3)])
def test_draws_are_distributed_as_one_after_the_other(weights: list[float], k: int) -> None:
    # here, since it takes seconds to import and every worker imports every module
    from scipy.stats import chi2

    rng = np.random.default_rng(7)
    n = 20_000
    seen: dict[tuple[int, ...], int] = {}
    for uniforms in rng.uniform(size=(n, len(weights))):
        drawn = sample_without_replacement(np.array(weights), k, uniforms)
        assert len(set(drawn.tolist())) == k
        assert np.all(np.diff(drawn) > 0)
        seen[tuple(drawn.tolist())] = seen.get(tuple(drawn.tolist()), 0) + 1
    want = exact_probabilities(weights, k)
    assert set(seen) <= set(want), "what weighs nothing was drawn"
    statistic = sum((seen.get(key, 0) - n * p) ** 2 / (n * p) for key, p in want.items())
    assert statistic < chi2.ppf(0.999, len(want) - 1)


def test_impossible_draws_are_told_with_their_numbers() -> None:
    with pytest.raises(ValueError, match="k is 3; of 3 weights 2 are positive, and so many can be drawn"):
        sample_without_replacement(np.array([1.0, 0.0, 1.0]), 3, np.zeros(3))
    with pytest.raises(ValueError, match="k is -1"):
        sample_without_replacement(np.ones(2), -1, np.zeros(2))
    with pytest.raises(ValueError, match=r"weights\[1\] is nan"):
        sample_without_replacement(np.array([1.0, np.nan]), 1, np.zeros(2))
    with pytest.raises(ValueError, match=r"uniforms must be in \[0, 1\)"):
        sample_without_replacement(np.ones(2), 1, np.array([0.5, 1.0]))
    with pytest.raises((ValueError, TypeError), match="uniforms"):
        sample_without_replacement(np.ones(2), 1, np.zeros(3))


# Mini-Splatting's importance by loops, and point sizes against scipy's neighbours.


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


# Speedy-Splat's score against derivatives of single pixels, by the renderer's own transpose and by differences.

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


# Fisher blocks against the outer products of every pixel's and channel's own gradient.


def one_hots(view: Camera):
    for y in range(view.height):
        for x in range(view.width):
            for c in range(3):
                v_image = np.zeros((view.height, view.width, 3))
                v_image[y, x, c] = 1.0
                yield c, v_image


def moments_of(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None = None) -> np.ndarray:
    drawn = render(gaussians, view, BACKGROUND, sh_degree, profile)
    size = profile.tile_size
    return screen_moments(drawn.splats, drawn.tile_lists, view.width, view.height, size, BACKGROUND, profile)


def blocks_by_pixel(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None) -> np.ndarray:
    """Sum g g^T over pixels and channels, g from the whole renderer's transpose of a one-hot cotangent."""
    blocks = np.zeros((len(gaussians), 6, 6))
    for _, v_image in one_hots(view):
        v = render_vjp(gaussians, view, v_image, background=BACKGROUND, sh_degree=sh_degree, profile=profile)
        g = np.concatenate([v.means, v.scales * gaussians.scales], axis=1)
        blocks += g[:, :, None] * g[:, None, :]
    return blocks


@pytest.mark.parametrize("profile", [PAPER, INRIA, SPEEDY_SPLAT], ids=lambda p: p.name)
@pytest.mark.parametrize(("n_sh", "degree"), [(1, None), (16, None), (16, 1)])
def test_blocks_are_the_sums_of_outer_products(profile: Profile, n_sh: int, degree: int | None) -> None:
    gaussians, view = random_gaussians(2, 6, n_sh), tilted_camera()
    # one at the ceiling, where profiles differ in what they let through
    gaussians = replace(gaussians, opacities=np.append(gaussians.opacities[:-1], 1.0))
    want = blocks_by_pixel(gaussians, view, profile, degree)
    found = fisher_blocks(gaussians, view, moments_of(gaussians, view, profile, degree), degree, profile)
    scale = np.max(np.abs(want), axis=(1, 2), keepdims=True)
    assert np.count_nonzero(scale) >= 4
    assert np.all(np.abs(found - want) <= 1e-11 * scale)
    assert np.array_equal(found, np.swapaxes(found, 1, 2))


def test_the_view_direction_counts_and_channels_do_not_leak_into_each_other() -> None:
    # with colours that depend on direction in one channel only, the two others have the block of flat colours
    gaussians, view = random_gaussians(2, 6, 4), camera()
    painted = gaussians.sh.copy()
    painted[:, 1:, 1:] = 0.0
    flat = painted.copy()
    flat[:, 1:] = 0.0
    directed, plain = replace(gaussians, sh=painted), replace(gaussians, sh=flat)
    blocks = [fisher_blocks(g, view, moments_of(g, view, PAPER)) for g in (directed, plain)]
    assert not np.allclose(blocks[0], blocks[1])
    np.testing.assert_allclose(blocks[0], blocks_by_pixel(directed, view, PAPER, None), rtol=1e-8, atol=1e-12)


def test_moments_are_those_of_single_pixels_in_the_order_that_is_stated() -> None:
    gaussians, view = random_gaussians(4, 5, 1), camera(4, 3)
    drawn = render(gaussians, view, BACKGROUND)
    want = np.zeros((len(gaussians), 31))
    for c, v_image in one_hots(view):
        args = (drawn.splats, drawn.tile_lists, view.width, view.height, PAPER.tile_size, v_image)
        v = composite_vjp(*args, background=BACKGROUND)
        q, w = np.concatenate([v.v_means2d, v.v_conics], axis=1), v.v_colors[:, c]
        pairs = [(i, j) for i in range(5) for j in range(i, 5)]
        want[:, :15] += np.stack([q[:, i] * q[:, j] for i, j in pairs], axis=1)
        want[:, 15 + 5 * c : 20 + 5 * c] += q * w[:, None]
        # the same in all three channels: counted once
        want[:, 30] += w * w * (c == 0)
    found = moments_of(gaussians, view, PAPER)
    assert np.all(np.any(want[:4] != 0.0, axis=1))
    np.testing.assert_allclose(found, want, rtol=1e-10, atol=1e-13)


def test_scores_are_log_determinants() -> None:
    rng = np.random.default_rng(1)
    A = rng.normal(size=(5, 6, 8)) * np.exp(rng.normal(size=(5, 6, 1)))
    blocks = A @ np.swapaxes(A, 1, 2)
    np.testing.assert_allclose(log_det_scores(blocks), np.linalg.slogdet(blocks)[1], rtol=1e-11)


def test_scores_do_not_lose_a_flat_gaussian_and_know_a_deficient_block() -> None:
    rng = np.random.default_rng(2)
    A = rng.normal(size=(6, 9))
    sound = A @ A.T
    units = np.array([1e6, 1e6, 1e6, 1.0, 1.0, 1e-7])
    # units change the determinant by their squares; singular values of the block as it is would have lost the last
    scores = log_det_scores(np.stack([sound, sound * np.outer(units, units)]))
    assert scores[1] == pytest.approx(scores[0] + 2.0 * np.sum(np.log(units)), rel=1e-12)
    deficient = A[:, :4] @ A[:, :4].T
    assert log_det_scores(np.stack([deficient, np.zeros((6, 6))])).tolist() == [-np.inf, -np.inf]


def test_what_does_not_fit_is_told() -> None:
    gaussians, view = random_gaussians(2, 3, 1), camera()
    drawn = render(gaussians, view)
    grey = replace(drawn.splats, colors=drawn.splats.colors[:, :1])
    with pytest.raises(ValueError, match="splats have 1 colour channels; they must have 3"):
        screen_moments(grey, drawn.tile_lists, view.width, view.height, 16)
    with pytest.raises(ValueError, match=r"moments has shape \[2, 31\]; it must be \[3, 31\]"):
        fisher_blocks(gaussians, view, np.zeros((2, 31)))
