"""Blending against exact rationals: dyadic alphas, dyadic thresholds, every equality decided as the profile says."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import (
    GSPLAT_1_5,
    GSPLAT_1_6,
    INRIA,
    PAPER,
    SPEEDY_SPLAT,
    Camera,
    Gaussians,
    Profile,
    Splats,
    alpha,
    dominance,
    render,
)
from pop_ref.compositing import composite, composite_vjp
from pop_ref.contributions import contributions
from pop_ref.depth import expected_depth, expected_depth_vjp, with_depth_channel
from pop_ref.pixel import Pixel, SplatRows, composite_pixel, composite_pixel_vjp, stops, zero_gradients
from tests.oracle.dense import blended_pixels
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, safe_gaussians, tilted_camera

# floats hold every sum and product below exactly, so that the comparison is too
DYADIC = replace(PAPER, alpha_floor=1 / 8, alpha_ceiling=7 / 8, transmittance_stop=1 / 64)
DYADIC_STRICT = replace(DYADIC, stop_inclusive=False, ceiling_gradient="pass")
NO_STOP = replace(DYADIC, transmittance_stop=-1.0)

eighths = st.integers(0, 8).map(lambda k: k / 8.0)
stacks = st.lists(st.tuples(eighths, st.integers(-4, 4).map(float)), max_size=7)
backgrounds = st.integers(-4, 4).map(float)
profiles = st.sampled_from([DYADIC, DYADIC_STRICT, NO_STOP])


def blend(stack: list[tuple[float, float]], background: float, profile: Profile) -> tuple[Pixel, SplatRows]:
    """Blend splats that all sit on the pixel's centre, where exp(-sigma) = 1 and alpha is the opacity."""
    n = len(stack)
    rows = SplatRows([[0.5, 0.5]] * n, [[1.0, 0.0, 1.0]] * n, [o for o, _ in stack], [[c] for _, c in stack])
    return composite_pixel(range(n), rows, 0.5, 0.5, [background], profile), rows


class Exact:
    """The same pixel from the definition, in rationals: which splats take part, prefix products, first stop, sums."""

    def __init__(self, stack: list[tuple[float, float]], background: float, profile: Profile) -> None:
        floor, ceiling, stop = map(Fraction, (profile.alpha_floor, profile.alpha_ceiling, profile.transmittance_stop))
        part = [i for i, (o, _) in enumerate(stack) if Fraction(o) >= floor]
        alphas = [min(Fraction(stack[i][0]), ceiling) for i in part]
        T = [math.prod((1 - a for a in alphas[:k]), start=Fraction(1)) for k in range(len(part) + 1)]
        ends = [k for k in range(len(part)) if T[k + 1] < stop or (profile.stop_inclusive and T[k + 1] == stop)]
        m = ends[0] if ends else len(part)
        self.ids, self.alphas, self.T = part[:m], alphas[:m], T[: m + 1]
        self.n_traversed = part[m] + 1 if ends else len(stack)
        self.colors = [Fraction(stack[i][1]) for i in self.ids]
        self.background = Fraction(background)
        weighted = [t * a * c for t, a, c in zip(self.T, self.alphas, self.colors, strict=False)]
        self.color = sum(weighted, start=self.T[m] * self.background)

    def gradient_of_alpha(self, k: int) -> Fraction:
        """Differentiate by alpha_k as the papers write it, with the division by 1 - alpha_k."""
        behind = self.T[-1] * self.background
        for j in range(k + 1, len(self.ids)):
            behind += self.T[j] * self.alphas[j] * self.colors[j]
        return self.T[k] * self.colors[k] - behind / (1 - self.alphas[k])


@given(stacks, backgrounds, profiles)
def test_a_pixel_equals_the_exact_rational_one(
    stack: list[tuple[float, float]], background: float, profile: Profile
) -> None:
    pixel, _ = blend(stack, background, profile)
    exact = Exact(stack, background, profile)
    assert pixel.ids == exact.ids
    assert pixel.n_traversed == exact.n_traversed
    assert Fraction(pixel.T_final) == exact.T[-1]
    assert [Fraction(a) for a in pixel.alphas] == exact.alphas
    assert [Fraction(t) for t in pixel.transmittances] == exact.T[:-1]
    assert Fraction(pixel.color[0]) == exact.color


@given(stacks, backgrounds, profiles)
def test_a_pixel_s_gradient_equals_the_exact_rational_one(
    stack: list[tuple[float, float]], background: float, profile: Profile
) -> None:
    pixel, rows = blend(stack, background, profile)
    exact = Exact(stack, background, profile)
    totals = zero_gradients(len(stack), 1)
    composite_pixel_vjp(pixel, rows, 0.5, 0.5, [background], [1.0], 0.0, totals, profile)
    for k, i in enumerate(exact.ids):
        passes = Fraction(stack[i][0]) <= Fraction(profile.alpha_ceiling) or profile.ceiling_gradient == "pass"
        assert Fraction(totals.v_opacities[i]) == (exact.gradient_of_alpha(k) if passes else 0)
        assert Fraction(totals.v_colors[i, 0]) == exact.T[k] * exact.alphas[k]
    others = [i for i in range(len(stack)) if i not in exact.ids]
    assert np.all(totals.v_opacities[others] == 0.0)
    assert Fraction(totals.v_background[0]) == exact.T[-1]


@given(stacks, profiles)
def test_weights_and_the_light_left_sum_to_exactly_one(stack: list[tuple[float, float]], profile: Profile) -> None:
    # eq. 1 with every colour and the background 1
    pixel, _ = blend([(o, 1.0) for o, _ in stack], 1.0, profile)
    assert sum(map(Fraction, pixel.weights), start=Fraction(pixel.T_final)) == 1
    assert pixel.color == [1.0]


@given(stacks, stacks, backgrounds)
def test_stacks_compose_as_light_through_the_front_one(
    front: list[tuple[float, float]], back: list[tuple[float, float]], background: float
) -> None:
    both, _ = blend(front + back, background, NO_STOP)
    first, _ = blend(front, 0.0, NO_STOP)
    second, _ = blend(back, background, NO_STOP)
    whole = Fraction(first.color[0]) + Fraction(first.T_final) * Fraction(second.color[0])
    # 14 alphas of three bits each and a colour fit a float64's 53 bits
    assert Fraction(both.color[0]) == whole
    assert Fraction(both.T_final) == Fraction(first.T_final) * Fraction(second.T_final)


def test_the_splat_that_would_reach_the_stop_is_visited_but_not_blended() -> None:
    # T: 1, 1/8, then 1/64 which is the stop itself
    stack = [(7 / 8, 1.0), (7 / 8, 2.0), (1 / 2, 4.0)]
    inclusive, _ = blend(stack, 0.0, DYADIC)
    assert (inclusive.ids, inclusive.n_traversed, inclusive.T_final) == ([0], 2, 1 / 8)
    exclusive, _ = blend(stack, 0.0, DYADIC_STRICT)
    assert (exclusive.ids, exclusive.n_traversed, exclusive.T_final) == ([0, 1], 3, 1 / 64)


def test_skipped_splats_are_visited_but_do_not_stop_a_pixel() -> None:
    pixel, _ = blend([(7 / 8, 1.0), (1 / 16, 1.0), (0.0, 1.0)], 0.0, DYADIC)
    assert (pixel.ids, pixel.n_traversed) == ([0], 3)


@pytest.mark.parametrize(("profile", "left"), [(PAPER, 1e-3), (GSPLAT_1_5, 1e-3), (GSPLAT_1_6, 1e-2), (INRIA, 1e-2)])
def test_the_second_of_two_opaque_splats_ends_the_pixel_unblended(profile: Profile, left: float) -> None:
    pixel, _ = blend([(1.0, 1.0), (1.0, 1.0), (1.0, 1.0)], 0.0, profile)
    assert (pixel.ids, pixel.n_traversed) == ([0], 2)
    np.testing.assert_allclose(pixel.T_final, left, rtol=1e-6)
    # float32 kernels decide the same
    T = np.float32(1.0) - np.float32(profile.alpha_ceiling)
    assert stops(float(T * T), profile)
    assert not stops(float(T), profile)


def test_a_splat_behind_an_opaque_one_is_blended_where_enough_light_is_left() -> None:
    paper, _ = blend([(1.0, 1.0), (0.875, 1.0), (1.0, 1.0)], 0.0, PAPER)
    assert (paper.ids, paper.n_traversed) == ([0, 1], 3)
    inria, _ = blend([(1.0, 1.0), (0.875, 1.0), (1.0, 1.0)], 0.0, INRIA)
    assert (inria.ids, inria.n_traversed) == ([0, 1], 3)


def test_the_stop_itself_ends_a_pixel_only_where_it_is_inclusive() -> None:
    stop = PAPER.transmittance_stop
    assert stops(stop, PAPER)
    assert not stops(stop, INRIA)
    assert stops(math.nextafter(stop, 0.0), INRIA)
    assert not stops(math.nextafter(stop, 1.0), PAPER)


def one_splat() -> Splats:
    return Splats(
        means2d=np.array([[0.5, 0.5]]),
        depths=np.array([1.0]),
        conics=np.array([[1.0, 0.0, 1.0]]),
        opacities=np.array([0.5]),
        colors=np.array([[1.0, 2.0]]),
        radii=np.array([[3, 3]]),
    )


def test_a_pixel_outside_every_list_is_the_background() -> None:
    out = composite(one_splat(), [[0], []], 4, 2, 2, np.array([3.0, 5.0]))
    assert out.image[0, 0].tolist() == [2.0, 3.5]
    assert np.all(out.image[:, 2:] == [3.0, 5.0])
    assert np.all(out.T_final[:, 2:] == 1.0)
    assert np.all(out.dominant_ids[:, 2:] == -1)
    assert np.all(out.dominant_weights[:, 2:] == 0.0)
    assert np.all(out.n_blended[:, 2:] == 0)
    assert np.all(out.n_traversed[:, 2:] == 0)


def test_lists_and_backgrounds_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="lists has 1 tiles; 4 x 2 px in 2 px tiles need 2"):
        composite(one_splat(), [[0]], 4, 2, 2)
    with pytest.raises(ValueError, match=r"background has shape \[3\]; it must be \[2\]"):
        composite(one_splat(), [[0], []], 4, 2, 2, np.zeros(3))
    with pytest.raises(ValueError, match="lists has 1 tiles"):
        composite_vjp(one_splat(), [[0]], 4, 2, 2, np.zeros((2, 4, 2)))


# One splat at one pixel: the quadratic form, and floor and ceiling at their edges.

# the kernels' 0.99
FLOAT32_99 = float(np.float32(0.99))

coordinates = st.integers(-64, 64).map(lambda k: k / 8.0)


@given(coordinates, coordinates, coordinates, coordinates, coordinates)
def test_sigma_is_half_the_quadratic_form(u: float, v: float, A: float, B: float, C: float) -> None:
    # eighths in, products of three eighths out: exact in float64
    d = np.array([u - 0.5, v - 1.5])
    want = 0.5 * float(d @ np.array([[A, B], [B, C]]) @ d)
    assert alpha.sigma_at_pixel((u, v), (A, B, C), 0.5, 1.5) == want


@given(st.floats(0.0, 700.0))
def test_falloff_is_the_exponential(sigma: float) -> None:
    assert alpha.falloff(sigma) == math.exp(-sigma)


@pytest.mark.parametrize(("profile", "ceiling"), [(PAPER, 0.999), (GSPLAT_1_6, FLOAT32_99), (INRIA, FLOAT32_99)])
def test_an_opaque_splat_stays_at_the_ceiling(profile: Profile, ceiling: float) -> None:
    assert alpha.alpha_from_sigma(0.0, 1.0, profile) == (ceiling, False)


def test_opacity_zero_is_skipped() -> None:
    assert alpha.alpha_from_sigma(0.0, 0.0) == (0.0, True)


# Dominance by brute force, ties above all.

weights = st.lists(st.sampled_from([0.125, 0.25, 0.25, 0.5]), max_size=6)


def test_a_weight_of_zero_never_wins() -> None:
    assert dominance.dominant_id([3, 4], [0.0, 0.0]) == -1


def test_the_terminating_splat_does_not_compete() -> None:
    # the second would weigh more than the first but ends the pixel
    profile = replace(PAPER, alpha_floor=1 / 256, alpha_ceiling=1.0, transmittance_stop=0.25)
    out = render(grey([0.25, 0.875]), dyadic_camera(1, 1), profile=profile)
    assert (out.n_blended[0, 0], out.n_traversed[0, 0]) == (1, 2)
    assert out.dominant_ids[0, 0] == 0


# The depth modes: by hand for one splat, and as a colour channel that holds depths.

VIEW = tilted_camera()


def test_one_splat_accumulates_its_depth_times_its_alpha_and_is_expected_at_its_depth() -> None:
    g = Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]])
    camera = Camera(np.eye(4), np.array([[8.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]]), 1, 1)
    seen = {mode: render(g, camera, np.ones(3), render_mode=mode).image[0, 0].tolist() for mode in ("D", "RGB+ED")}
    assert seen == {"D": [2.0], "RGB+ED": [0.75, 0.75, 0.75, 4.0]}


def test_the_accumulated_depth_is_a_colour_that_holds_depths() -> None:
    g = safe_gaussians(VIEW)
    plain = render(g, VIEW)
    as_colour = render(g, VIEW, colors=plain.splats.depths[:, None])
    both = render(g, VIEW, np.ones(3), render_mode="RGB+D")
    np.testing.assert_array_equal(both.image[..., 3:], as_colour.image)
    np.testing.assert_array_equal(both.image[..., :3], render(g, VIEW, np.ones(3)).image)
    np.testing.assert_array_equal(render(g, VIEW, np.ones(3), render_mode="D").image, as_colour.image)
    assert both.splats.colors.shape[1] == 3


def test_an_empty_pixel_has_no_depth_and_passes_none_to_its_opacity() -> None:
    empty = np.zeros((1, 1)), np.ones((1, 1))
    assert expected_depth(*empty).item() == 0.0
    assert [v.item() for v in expected_depth_vjp(*empty, np.ones((1, 1)))] == [1e10, 0.0]


def test_a_mode_that_is_none_and_a_background_with_depth_are_refused() -> None:
    g = safe_gaussians(VIEW)
    with pytest.raises(ValueError, match="render_mode is 'depth'; it must be one of RGB, D, ED, RGB\\+D, RGB\\+ED"):
        with_depth_channel(render(g, VIEW).splats, "depth")
    with pytest.raises(ValueError, match=r"background has shape \[4\]; it must be \[3\]"):
        render(g, VIEW, np.ones(4), render_mode="RGB+D")


# Contributions against lists of what each pixel blends, made from the definition.

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
        for i, T, a in blended:
            weights[i] += T * a
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
