"""Whole renders against one without tiles, pixels against exact rationals, maps against lists of what is blended.

Single stages up to the screen stand at the end, held to mpmath and SciPy, and at the ends of their domains.
"""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

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
    activations,
    covariance,
    footprint,
    harmonics,
    margins,
    projection,
    render,
    render_vjp,
    tiles,
)
from pop_ref.chord import chord_midpoint, dominant_points
from pop_ref.compositing import composite, composite_vjp
from pop_ref.contributions import contributions
from pop_ref.depth import expected_depth, expected_depth_vjp, with_depth_channel
from pop_ref.pixel import Pixel, SplatRows, composite_pixel, composite_pixel_vjp, stops, zero_gradients
from pop_ref.splatting import geometry
from pop_ref.tight_tiles import accutile, tight_tile_lists
from pop_ref.tiles import tile_rects
from tests.oracle.scenes import (
    blended_pixels,
    camera,
    dense_render,
    dyadic_camera,
    grey,
    random_gaussians,
    rotations,
    safe_gaussians,
    tilted_camera,
)

BACKGROUND = np.array([0.5, 0.25, 1.0])


@given(st.integers(0, 10**6), st.integers(0, 24), st.sampled_from([PAPER, GSPLAT_1_6]), st.sampled_from([1, 3, 16]))
def test_a_render_equals_one_without_tiles(seed: int, n: int, profile: Profile, tile_size: int) -> None:
    gaussians, view = random_gaussians(seed, n, n_sh=1) if n else grey([]), tilted_camera(11, 9)
    got = render(gaussians, view, BACKGROUND, profile=profile, tile_size=tile_size)
    want = dense_render(gaussians, view, BACKGROUND, profile)
    np.testing.assert_allclose(got.image, want.image, atol=1e-12)
    np.testing.assert_allclose(got.T_final, want.T_final, atol=1e-13)
    # float64 rounds differently here and there: integers must agree where no decision is within its reach
    safe = margins(gaussians, view, profile=profile, tile_size=tile_size).safe_pixels(1e-14)
    assert np.mean(safe) > 0.99
    assert np.array_equal(got.dominant_ids[safe], want.dominant_ids[safe])
    assert np.array_equal(got.n_blended[safe], want.n_blended[safe])


def test_inria_s_tile_grid_is_part_of_its_meaning() -> None:
    # an opaque splat is cut at its 3-sigma square, rounded out to whole tiles
    gaussians, view = grey([1.0], scale=10.0), dyadic_camera(81, 1)
    coarse, fine = (render(gaussians, view, profile=INRIA, tile_size=t) for t in (16, 1))
    # alpha reaches the floor 33 px from the middle pixel, the square 31, and its last column is cut off
    assert coarse.splats.radii.tolist() == [[31, 31]]
    assert coarse.n_blended[0].tolist() == [0] * 7 + [1] * 67 + [0] * 7
    assert fine.n_blended[0].tolist() == [0] * 9 + [1] * 62 + [0] * 10
    assert render(gaussians, view, tile_size=1).n_blended[0].tolist() == [0] * 7 + [1] * 67 + [0] * 7


def test_inria_s_cull_reads_the_tile_grid_that_is_asked_for() -> None:
    # 3 px of extent about u = 35, right of an image of 20 px: inside the second tile of 16, outside every tile of 4
    gaussians, view = grey([1.0], means=[[25.0, 0.0, 4.0]], scale=0.0), dyadic_camera(20, 16)
    assert render(gaussians, view, profile=INRIA).splats.visible[0]
    assert not render(gaussians, view, profile=INRIA, tile_size=4).splats.visible[0]


def test_a_needle_so_long_that_its_determinant_is_lost_is_culled_without_a_warning() -> None:
    n_culled = 0
    for quat in ([1.0, 0.1, 0.2, 0.3], [4.0, 0.0, 0.0, 1.0], [3.0, 0.0, 0.0, 2.0], [1.0, 0.2, 0.1, 0.4]):
        needle = replace(grey([0.5]), scales=np.array([[1e12, 0.0, 0.0]]), quats=np.array([quat]))
        out = render(needle, dyadic_camera(5, 5))
        covar = geometry(needle, dyadic_camera(5, 5)).blurred[0]
        assert bool(out.splats.visible[0]) == (covar[0, 0] * covar[1, 1] - covar[0, 1] * covar[1, 0] > 0.0)
        assert np.all(np.isfinite(out.image))
        assert np.all((out.T_final == 1.0) | out.splats.visible[0])
        n_culled += not out.splats.visible[0]
    assert n_culled > 0


def test_antialiased_mode_dims_small_splats_by_the_energy_they_gained() -> None:
    view = dyadic_camera(5, 5)
    classic, antialiased = (render(grey([1.0], scale=0.5), view, antialiased=a) for a in (False, True))
    np.testing.assert_allclose(antialiased.splats.opacities[0], 0.25 / (0.25 + 0.3), rtol=1e-14)
    assert classic.splats.opacities[0] == 1.0
    # the factor enters the extents too
    small = render(grey([1.0], scale=0.05), view, antialiased=True).splats
    factor = 0.05**2 / (0.05**2 + 0.3)
    assert factor > PAPER.alpha_floor
    want = math.ceil(math.sqrt(2.0 * math.log(factor / PAPER.alpha_floor)) * math.sqrt(0.05**2 + 0.3))
    assert small.radii[0].tolist() == [want, want]
    assert not render(grey([1.0], scale=0.0), view, antialiased=True).splats.visible[0]


def test_the_default_degree_uses_every_band() -> None:
    gaussians, view = random_gaussians(5, 4, n_sh=9), tilted_camera()
    assert np.array_equal(render(gaussians, view).image, render(gaussians, view, sh_degree=2).image)
    assert not np.array_equal(render(gaussians, view).image, render(gaussians, view, sh_degree=1).image)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"width": 0}, "width is 0; it must be a whole number of px, >= 1"),
        ({"height": 2.5}, "height is 2.5; it must be a whole number"),
        ({"width": True}, "width is True; it must be a whole number"),
        ({"K": np.diag([1.0, 0.0, 1.0])}, "both must be > 0"),
        ({"K": np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "skew is not supported"),
        ({"viewmat": 2.0 * np.eye(4)}, "viewmat is not rigid"),
        ({"viewmat": np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * np.eye(4)[3][:, None] * 0.5}, "the last row must be"),
    ],
)
def test_a_camera_that_is_none_is_refused_by_what_is_wrong(change: dict, words: str) -> None:
    given = {"viewmat": np.eye(4), "K": np.eye(3), "width": np.int64(4), "height": 3}
    Camera(**given)
    with pytest.raises(ValueError, match=words):
        Camera(**{**given, **change})


def test_a_render_leaves_its_arguments_alone() -> None:
    gaussians, view = random_gaussians(6, 8), tilted_camera()
    before = {name: array.copy() for name, array in vars(gaussians).items()}
    render(gaussians, view, BACKGROUND)
    assert all(np.array_equal(array, before[name]) for name, array in vars(gaussians).items())


# Blending against exact rationals: every equality is decided as the profile says.

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


# T: 1, 1/8, then 1/64, which is the stop itself
AT_THE_STOP = [(7 / 8, 1.0), (1 / 16, 3.0), (7 / 8, 2.0), (1 / 2, 4.0)]


@given(stacks, backgrounds, profiles)
@example(AT_THE_STOP, 1.0, DYADIC)
@example(AT_THE_STOP, 1.0, DYADIC_STRICT)
def test_a_pixel_equals_the_exact_rational_one(stack, background, profile):
    pixel, _ = blend(stack, background, profile)
    exact = Exact(stack, background, profile)
    assert pixel.ids == exact.ids
    assert pixel.n_traversed == exact.n_traversed
    assert Fraction(pixel.T_final) == exact.T[-1]
    assert [Fraction(a) for a in pixel.alphas] == exact.alphas
    assert [Fraction(t) for t in pixel.transmittances] == exact.T[:-1]
    assert Fraction(pixel.color[0]) == exact.color


@given(stacks, backgrounds, profiles)
def test_a_pixel_s_gradient_equals_the_exact_rational_one(stack, background, profile):
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


@pytest.mark.parametrize(("profile", "left"), [(PAPER, 1e-3), (GSPLAT_1_5, 1e-3), (GSPLAT_1_6, 1e-2), (INRIA, 1e-2)])
def test_the_second_of_two_opaque_splats_ends_the_pixel_unblended(profile: Profile, left: float) -> None:
    pixel, _ = blend([(1.0, 1.0), (1.0, 1.0), (1.0, 1.0)], 0.0, profile)
    assert (pixel.ids, pixel.n_traversed) == ([0], 2)
    np.testing.assert_allclose(pixel.T_final, left, rtol=1e-6)
    # float32 kernels decide the same
    T = np.float32(1.0) - np.float32(profile.alpha_ceiling)
    assert stops(float(T * T), profile)
    assert not stops(float(T), profile)


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


@pytest.mark.parametrize("shape", [(9, 7, 3), (11, 9, 3), (7, 9, 5), (7, 9, 1)])
def test_cotangents_and_colours_of_another_shape_are_refused(shape: tuple[int, int, int]) -> None:
    gaussians, view = random_gaussians(0), tilted_camera(9, 7)
    with pytest.raises(ValueError, match=rf"v_image has shape \[{shape[0]}, {shape[1]}, \d\]; it must be \[7, 9, 3\]"):
        render_vjp(gaussians, view, np.ones(shape))
    for n in (len(gaussians) + 1, len(gaussians) - 1):
        with pytest.raises(ValueError, match=rf"colors has shape \[{n}, 3\]; it must be \[{len(gaussians)}, D\]"):
            render(gaussians, view, colors=np.ones((n, 3)))


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

TILE = 4


@pytest.mark.parametrize("profile", [PAPER, INRIA, SPEEDY_SPLAT], ids=lambda p: p.name)
@pytest.mark.parametrize("view", [camera(), tilted_camera(9, 7)], ids=["straight", "tilted"])
def test_the_sums_are_those_over_every_pixels_list(profile: Profile, view) -> None:
    gaussians = random_gaussians(5, 12)
    drawn = render(gaussians, view, profile=profile, tile_size=TILE)
    shown = np.random.default_rng(0).uniform(size=drawn.T_final.shape)
    n = len(gaussians)
    weights, counts, of_map, distances = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    for (x, y), blended in blended_pixels(drawn, TILE, profile).items():
        for i, T, a in blended:
            weights[i] += T * a
            counts[i] += 1
            of_map[i] += shown[y, x]
            distances[i] += np.linalg.norm(np.array([x + 0.5, y + 0.5]) - drawn.splats.means2d[i])
    found = contributions(drawn.splats, drawn.tile_lists, view.width, view.height, TILE, shown, profile)
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


def test_a_tile_size_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="tile_size is 0; it must be >= 1"):
        tiles.grid_size(4, 4, 0)


@pytest.mark.parametrize("floor", [0.0, -1.0])
def test_an_alpha_floor_under_which_nothing_falls_is_refused(floor: float) -> None:
    open_, round_ = replace(PAPER, alpha_floor=floor), np.array([1.0, 0.0, 1.0])
    one, seen_by = grey([0.5]), dyadic_camera(3, 3)
    for draw in (
        lambda: render(one, seen_by, profile=open_),
        lambda: margins(one, seen_by, profile=open_),
        lambda: accutile(round_[:2], round_, 1.0, (0, 0, 4, 4), 4, open_),
    ):
        with pytest.raises(ValueError, match=rf"profile 'paper': alpha_floor is {floor}; it must be in \(0, 1\)"):
            draw()


def test_a_conic_that_vanished_is_everywhere_and_an_ellipse_that_is_a_point_in_its_tile() -> None:
    assert len(accutile(np.array([9.0, 9.0]), np.zeros(3), 1.0, (1, 1, 3, 4), 4)) == 6
    # at the floor itself nothing but the centre is left; in profile inria it is listed, and blended at the centre
    round_ = np.array([1.0, 0.0, 1.0])
    assert accutile(np.array([9.5, 6.5]), round_, INRIA.alpha_floor, (0, 0, 4, 4), 4, INRIA) == [(2, 1)]


def test_squares_cut_the_ellipse_off() -> None:
    # at o = 1 the ellipse reaches 3.33 standard deviations and Inria's square 3: its tiles are those of both
    means2d, conics, opacities = np.array([[10.0, 10.0]]), np.array([[1 / 9.0, 0.0, 1 / 9.0]]), np.ones(1)
    radii, depths = np.array([[9, 9]]), np.ones(1)
    tight = tight_tile_lists(means2d, conics, opacities, radii, depths, 20, 20, 1, INRIA)
    rect = tuple(tile_rects(means2d, radii, 20, 20, 1, INRIA)[0].tolist())
    ellipse = set(accutile(means2d[0], conics[0], 1.0, (0, 0, 20, 20), 1, INRIA))
    square = {(x, y) for x in range(rect[0], rect[2]) for y in range(rect[1], rect[3])}
    listed = {(k % 20, k // 20) for k, ids in enumerate(tight) if ids}
    assert listed == ellipse & square
    assert ellipse - square
    assert square - ellipse


# Points on rays, each pixel by its list.


def test_a_scale_of_zero_is_told() -> None:
    with pytest.raises(ValueError, match=r"scale is \[1.0, 0.0, 1.0\]; each must be > 0"):
        chord_midpoint(np.zeros(3), np.ones(4), np.array([1.0, 0.0, 1.0]), np.zeros(3), np.ones(3))


def points_by_list(gaussians: Gaussians, view: Camera, profile: Profile, tile_size: int):
    """Make the three maps pixel by pixel, rays by inverting the whole projection."""
    drawn = render(gaussians, view, profile=profile, tile_size=tile_size)
    shape = drawn.T_final.shape
    points, ids, T_final = np.zeros((*shape, 3)), np.full(shape, -1), np.ones(shape)
    K = view.K.copy()
    if profile.principal_point == "centred":
        K[:2, 2] = 0.5 * view.width, 0.5 * view.height
    to_world = np.linalg.inv(view.viewmat)
    origin = to_world[:3, 3]
    R = rotations(gaussians.quats)
    for (x, y), blended in blended_pixels(drawn, tile_size, profile).items():
        end = to_world @ np.append(np.linalg.solve(K, [x + 0.5, y + 0.5, 1.0]), 1.0)
        direction = (end[:3] - origin) / np.linalg.norm(end[:3] - origin)
        best = 0.0
        for i, T, alpha in blended:
            precision = R[i] @ np.diag(gaussians.scales[i] ** -2.0) @ R[i].T
            t = direction @ precision @ (gaussians.means[i] - origin) / (direction @ precision @ direction)
            T_final[y, x] *= 1.0 - alpha
            if t >= 0.0 and T * alpha > best:
                best, ids[y, x], points[y, x] = T * alpha, i, origin + t * direction
    return drawn, points, ids, T_final


@pytest.mark.parametrize("profile", [PAPER, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("view", [camera(), tilted_camera(9, 7)], ids=["straight", "tilted"])
def test_each_pixel_has_the_point_of_its_heaviest_gaussian(profile: Profile, view: Camera) -> None:
    gaussians = random_gaussians(5, 12)
    drawn, points, ids, T_final = points_by_list(gaussians, view, profile, 4)
    found = dominant_points(drawn.splats, drawn.tile_lists, gaussians, view, 4, profile)
    assert len(set(ids.ravel().tolist())) > 3
    assert np.array_equal(found.ids, ids)
    np.testing.assert_allclose(found.points, points, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.T_final, drawn.T_final, rtol=0, atol=0)
    np.testing.assert_allclose(found.T_final, T_final, rtol=1e-12)
    if profile is PAPER:
        # every Gaussian here is ahead of the camera, so that those who compete are those who dominate
        assert np.array_equal(found.ids, drawn.dominant_ids)


def test_a_flat_gaussian_does_not_compete_and_an_empty_pixel_has_no_point() -> None:
    gaussians, view = grey([0.75, 0.25]), dyadic_camera(17, 1)
    flat = replace(gaussians, scales=np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]]))
    drawn = render(flat, view)
    found = dominant_points(drawn.splats, drawn.tile_lists, flat, view, 16)
    assert drawn.dominant_ids[0, 8] == 0
    assert found.ids[0, 8] == 1
    assert found.ids[0, 0] == -1
    assert found.points[0, 0].tolist() == [0.0, 0.0, 0.0]
    assert found.T_final[0, 0] == 1.0


# Single stages against mpmath and SciPy.

K = np.array([[7.0, 0.0, 3.25], [0.0, 9.0, 2.0], [0.0, 0.0, 1.0]])
WIDTH, HEIGHT = 6, 5

in_view = st.tuples(st.floats(-0.25, 0.25), st.floats(-0.2, 0.2), st.floats(0.5, 50.0))


@given(in_view)
def test_jacobians_are_the_pinhole_s_derivative_to_mpmath_s_digits(point: tuple[float, float, float]) -> None:
    slope_x, slope_y, z = point
    p = [slope_x * z, slope_y * z, z]
    with mpmath.workdps(40):
        pinhole = (lambda x, y, z: 7 * x / z, lambda x, y, z: 9 * y / z)
        orders = [(1, 0, 0), (0, 1, 0), (0, 0, 1)]
        want = [[float(mpmath.diff(f, tuple(map(mpmath.mpf, p)), n)) for n in orders] for f in pinhole]
    got = projection.projection_jacobians(np.array([p]), K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(got, want, rtol=1e-14, atol=1e-18)
    centre = projection.project_means(np.array([p]), K, WIDTH, HEIGHT)[0]
    np.testing.assert_allclose(centre, (K @ p)[:2] / z, rtol=1e-14)


@given(st.floats(-700.0, 700.0))
def test_opacities_are_the_logistic_function_to_the_last_bits(logit: float) -> None:
    with mpmath.workdps(40):
        want = float(1 / (1 + mpmath.exp(-mpmath.mpf(logit))))
    np.testing.assert_allclose(activations.opacities_from_logits(np.array([logit]))[0], want, rtol=4e-16)


@given(st.floats(-20.0, 20.0))
def test_scales_are_exponentials(log_scale: float) -> None:
    got = activations.scales_from_log_scales(np.array([[log_scale] * 3]))
    np.testing.assert_allclose(got, math.exp(log_scale), rtol=4e-16)


def test_quaternions_whose_squares_underflow_or_overflow_are_still_normalised() -> None:
    for size in (1e-200, 1e200):
        quats = np.full((1, 4), size)
        np.testing.assert_allclose(activations.unit_quats_from_quats(quats), 0.5, rtol=1e-15)
        one = {"means": np.zeros((1, 3)), "scales": np.ones((1, 3)), "opacities": np.ones(1), "sh": np.zeros((1, 1, 3))}
        with np.errstate(all="raise"):
            assert Gaussians(quats=quats, **one).quats.tolist() == quats.tolist()


def test_whole_numbers_are_taken_as_numbers_where_types_are_not_checked() -> None:
    # in a process of its own: in this one every argument that is no float64 is refused
    script = (
        "import numpy as np; from pop_ref import activations, camera; one = np.array([[1, 1, 1, 1]])\n"
        "print(activations.unit_quats_from_quats(one).tolist(), activations.opacities_from_logits(one[0, :1]).tolist(),"
        "camera.means_cam_from_means(one[:, :3], np.eye(4) + 0.5 * np.eye(4, k=1)).tolist())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[0] == "[[0.5, 0.5, 0.5, 0.5]] [0.7310585786300049] [[1.5, 1.5, 1.5]]"


# multiples of 1/1024, so that no square underflows where bits are compared
covariance_lattice = st.integers(-4096, 4096).map(lambda k: k / 1024.0)
quat_lists = st.lists(covariance_lattice, min_size=4, max_size=4).filter(any)


@given(quat_lists)
def test_rotations_are_those_of_scipy(quat: list[float]) -> None:
    w, x, y, z = quat
    want = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(covariance.rotmats_from_quats(np.array([quat]))[0], want, atol=2e-15)


def test_an_opacity_under_the_floor_has_no_extent_and_one_at_the_floor_a_zero_one() -> None:
    covars = np.tile(np.eye(2), (4, 1, 1))
    floor = PAPER.alpha_floor
    opacities = np.array([0.0, math.nextafter(floor, 0.0), floor, math.nextafter(floor, 1.0)])
    assert footprint.radii_from_covars2d(covars, opacities).tolist() == [[0, 0], [0, 0], [0, 0], [1, 1]]


def test_a_splat_without_an_ellipse_is_culled_and_so_is_a_needle_whose_determinant_rounds_to_nothing() -> None:
    covars = np.array([[[1.0, 2.0], [2.0, 1.0]], [[1.0, 1.0], [1.0, 1.0]], [[0.0, 0.0], [0.0, 0.0]]])
    assert np.all(footprint.compensations(covars, 0.25) == 0.0)
    needle = np.full((1, 2, 2), 1e18)
    blurred = footprint.low_pass(needle, PAPER.eps2d)
    assert np.array_equal(blurred, needle)
    for profile in (PAPER, INRIA):
        assert np.all(footprint.radii_from_covars2d(blurred, np.ones(1), profile) == 0)
        assert np.all(footprint.radii_from_covars2d(covars[2:], np.ones(1), profile) == 0)


def test_a_huge_splat_s_extent_fits_an_int32() -> None:
    radii = footprint.radii_from_covars2d(np.diag([1e30, 1e30])[None], np.ones(1))
    assert radii.tolist() == [[2**31 - 1, 2**31 - 1]]


HARMONICS_RNG = np.random.default_rng(8)
DIRS = HARMONICS_RNG.normal(size=(40, 3))
UNITS = DIRS / np.linalg.norm(DIRS, axis=1, keepdims=True)


def real_harmonic(l: int, m: int, units: np.ndarray) -> np.ndarray:
    """Combine SciPy's complex harmonics (with their Condon-Shortley phase) into the real one of the code bases."""
    theta, phi = np.arccos(units[:, 2]), np.arctan2(units[:, 1], units[:, 0])
    complex_values = sph_harm_y(l, abs(m), theta, phi)
    if m == 0:
        return complex_values.real
    return math.sqrt(2.0) * (complex_values.imag if m < 0 else complex_values.real)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_basis_is_that_of_scipy_in_order_and_sign(degree: int) -> None:
    basis = harmonics.sh_basis(UNITS, degree)
    want = [real_harmonic(l, m, UNITS) for l in range(degree + 1) for m in range(-l, l + 1)]
    assert basis.shape == (40, len(want))
    np.testing.assert_allclose(basis, np.stack(want, axis=1), atol=5e-15)


def test_a_lower_degree_loses_least_where_views_show_it_and_little_elsewhere() -> None:
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    z, phi = (grid.ravel() for grid in np.meshgrid(nodes, 2.0 * np.pi * np.arange(16) / 16, indexing="ij"))
    r = np.sqrt(1.0 - z * z)
    sphere = harmonics.sh_basis(np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1), 3)
    shares = np.repeat(node_weights, 16) / 32.0
    sh, dirs = HARMONICS_RNG.normal(size=(6, 16, 3)), HARMONICS_RNG.normal(size=(5, 6, 3))
    weights = HARMONICS_RNG.uniform(0.0, 4.0, size=(5, 6))
    weights[:, 5] = 0.0
    shown = [harmonics.sh_basis(view / np.linalg.norm(view, axis=1, keepdims=True), 3) for view in dirs]

    def loss(lower: np.ndarray, i: int) -> float:
        change = sh[i].copy()
        change[: len(lower)] -= lower
        seen = sum(w[i] * ((basis[i] @ change) ** 2).sum() for w, basis in zip(weights, shown, strict=True))
        return float(seen + 2.0 * (shares @ (sphere @ change) ** 2).sum())

    for degree in range(4):
        lower = harmonics.lower_degree(sh, dirs, weights, degree, uniform=2.0)
        # seen by no view: cut off
        np.testing.assert_allclose(lower[5], sh[5, : (degree + 1) ** 2], rtol=1e-15)
        for i in range(6):
            least = loss(lower[i], i)
            for _ in range(5):
                step = 1e-3 * HARMONICS_RNG.normal(size=lower[i].shape)
                # a quadratic is as much higher on one side of its minimum as on the other
                higher = [loss(lower[i] + sign * step, i) - least for sign in (-1.0, 1.0)]
                assert min(higher) > 0.0
                assert higher[0] == pytest.approx(higher[1], rel=1e-6)
    np.testing.assert_allclose(harmonics.lower_degree(sh, dirs, weights, 3), sh, rtol=1e-15)


def test_wrong_degrees_and_too_few_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="sh_degree is 4; it must be 0, 1, 2 or 3"):
        harmonics.sh_basis(UNITS, 4)
    with pytest.raises(ValueError, match="sh has 4 coefficients; sh_degree 2 needs 9"):
        harmonics.colors_from_sh(np.zeros((40, 4, 3)), DIRS, 2)
