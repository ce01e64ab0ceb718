"""Scores of other methods: edges by Pillow, draws by exact probabilities, derivatives pixel by pixel."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageFilter

from pop_ref import INRIA, PAPER, SPEEDY_SPLAT, Camera, Gaussians, Profile, Splats, losses, render, render_vjp, taming
from pop_ref.compositing import composite_vjp
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments
from pop_ref.mini_splatting import nearest_log_scales, samples_per_view, scene_importance
from pop_ref.selection import least_mass, lowest_share, sample_without_replacement
from pop_ref.sensitivity import sensitivities
from tests.oracle.scenes import camera, random_gaussians, tilted_camera


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


def test_what_is_no_photograph_is_told() -> None:
    with pytest.raises(ValueError, match=r"photo is float64 \[4, 4, 3\]; it must be uint8"):
        taming.edge_map(np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match=r"image has shape \[4, 5, 3\], photo \[4, 4, 3\]"):
        taming.pixel_weights(np.zeros((4, 5, 3)), np.zeros((4, 4, 3), dtype=np.uint8))


def test_scores_of_a_population_add_over_views_that_are_rendered_and_weighed() -> None:
    gaussians = random_gaussians(3, 9)
    rng = np.random.default_rng(0)
    views = [
        (v, rng.integers(0, 256, (v.height, v.width, 3)).astype(np.uint8)) for v in (camera(), tilted_camera(8, 9))
    ]
    grads, background = rng.exponential(size=9), np.array([0.0, 0.5, 1.0])
    kept = np.zeros(views[0][1].shape[:2], dtype=bool)
    kept[:, 3:] = True
    for profile, masks in ((INRIA, None), (PAPER, None), (INRIA, [kept, None])):
        want = np.zeros(9)
        for (view, photo), mask in zip(views, masks or (None, None), strict=True):
            drawn = render(gaussians, view, background, 1, profile)
            target = photo / 255.0
            weights = taming.pixel_weights(drawn.image, photo, mask)
            found = contributions(drawn.splats, drawn.tile_lists, view.width, view.height, 16, weights, profile)
            pixels = np.abs(drawn.image - target)
            l1 = np.mean(pixels if mask is None else pixels[mask])
            loss = 0.8 * l1 + 0.2 * losses.d_ssim(drawn.image, target, "same", mask)
            shown = (drawn.splats.depths, drawn.splats.radii, found)
            want += taming.view_score(loss, grads, gaussians.opacities, gaussians.scales, *shown)
        assert np.count_nonzero(want) > 4
        np.testing.assert_allclose(
            taming.taming_scores(gaussians, views, grads, background, 1, profile, masks), want, rtol=1e-10
        )


# Selection: draws against exact probabilities of small cases.


def test_views_and_points_that_are_none_are_told() -> None:
    with pytest.raises(ValueError, match="there are no views"):
        scene_importance([], outdoor=True)
    with pytest.raises(ValueError, match="n_views is 0; it must be >= 1"):
        samples_per_view(0, 8, 4)
    assert nearest_log_scales(np.zeros((0, 3))).shape == (0, 3)
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


# Speedy-Splat's score against derivatives of single pixels, by the renderer's own transpose.

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


# Fisher blocks against the outer products of every pixel's and channel's own gradient.


def one_hots(view: Camera):
    for y in range(view.height):
        for x in range(view.width):
            for c in range(3):
                v_image = np.zeros((view.height, view.width, 3))
                v_image[y, x, c] = 1.0
                yield v_image


def moments_of(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None = None) -> np.ndarray:
    drawn = render(gaussians, view, BACKGROUND, sh_degree, profile)
    size = profile.tile_size
    return screen_moments(drawn.splats, drawn.tile_lists, view.width, view.height, size, BACKGROUND, profile)


def blocks_by_pixel(gaussians: Gaussians, view: Camera, profile: Profile, sh_degree: int | None) -> np.ndarray:
    """Sum g g^T over pixels and channels, g from the whole renderer's transpose of a one-hot cotangent."""
    blocks = np.zeros((len(gaussians), 6, 6))
    for v_image in one_hots(view):
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


def test_what_does_not_fit_is_told() -> None:
    gaussians, view = random_gaussians(2, 3, 1), camera()
    drawn = render(gaussians, view)
    grey = replace(drawn.splats, colors=drawn.splats.colors[:, :1])
    with pytest.raises(ValueError, match="splats have 1 colour channels; they must have 3"):
        screen_moments(grey, drawn.tile_lists, view.width, view.height, 16)
    with pytest.raises(ValueError, match=r"moments has shape \[2, 31\]; it must be \[3, 31\]"):
        fisher_blocks(gaussians, view, np.zeros((2, 31)))
