"""The whole oracle against a renderer without tiles, and at the edges of its domain."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_ref import GSPLAT_1_6, INRIA, PAPER, Camera, Profile, margins, render
from pop_ref.splatting import geometry
from tests.oracle.dense import dense_render
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera

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


@given(st.integers(0, 10**6), st.sampled_from([PAPER, GSPLAT_1_6]))
def test_any_tile_size_gives_the_same_bits(seed: int, profile: Profile) -> None:
    gaussians, view = random_gaussians(seed, 8), tilted_camera(11, 9)
    whole = render(gaussians, view, BACKGROUND, profile=profile, tile_size=16)
    for tile_size in (1, 4):
        tiled = render(gaussians, view, BACKGROUND, profile=profile, tile_size=tile_size)
        for name in ("image", "T_final", "dominant_ids", "dominant_weights", "dominant_counts", "n_blended"):
            assert np.array_equal(getattr(tiled, name), getattr(whole, name)), name
        assert np.all(tiled.n_traversed <= whole.n_traversed)


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


def test_one_pixel_sees_a_gaussian_at_its_centre_at_its_opacity() -> None:
    out = render(grey([0.5]), dyadic_camera(1, 1), background=np.array([0.0, 1.0, 2.0]))
    assert out.image.tolist() == [[[0.25, 0.75, 1.25]]]
    assert out.T_final.tolist() == [[0.5]]
    assert out.dominant_ids.tolist() == [[0]]
    assert out.dominant_counts.tolist() == [1]


def test_in_inria_an_opacity_under_the_floor_is_listed_but_never_blended() -> None:
    out = render(grey([1.0 / 512.0]), dyadic_camera(1, 1), profile=INRIA)
    assert out.splats.visible[0]
    assert (out.n_traversed[0, 0], out.n_blended[0, 0]) == (1, 0)


def test_an_opacity_of_one_leaves_a_thousandth() -> None:
    out = render(grey([1.0]), dyadic_camera(1, 1))
    assert out.dominant_weights[0, 0] == 0.999
    np.testing.assert_allclose(out.T_final[0, 0], 1e-3, rtol=1e-12)


def test_of_coincident_opaque_copies_only_the_front_one_is_drawn() -> None:
    out = render(grey([1.0] * 4), dyadic_camera(3, 3))
    assert (out.n_blended[1, 1], out.n_traversed[1, 1]) == (1, 2)
    # every pixel goes to the copy of lowest index, however faint it is there
    assert out.dominant_counts.tolist() == [9, 0, 0, 0]


def test_a_gaussian_behind_the_camera_is_not_drawn_however_large() -> None:
    out = render(grey([1.0, 1.0], means=[[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]], scale=100.0), dyadic_camera(3, 3))
    assert np.all(out.T_final == 1.0)
    assert not np.any(out.splats.visible)


def test_a_gaussian_straddling_the_near_plane_is_kept_or_culled_whole_by_its_centre() -> None:
    near = PAPER.near_plane
    for z, kept in ((near, True), (math.nextafter(near, 0.0), False)):
        out = render(grey([0.5], means=[[0.0, 0.0, z]], scale=1.0), dyadic_camera(3, 3))
        assert bool(out.splats.visible[0]) is kept
        assert np.all(np.isfinite(out.image))
        assert np.all((out.T_final < 1.0) == kept)


def test_a_huge_gaussian_covers_every_pixel_alike() -> None:
    out = render(grey([0.5], scale=1e6), dyadic_camera(5, 5))
    np.testing.assert_allclose(out.T_final, 0.5, rtol=1e-9)
    assert out.dominant_counts.tolist() == [25]


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


def test_a_needle_is_as_thin_as_the_low_pass_and_as_long_as_itself() -> None:
    needle = replace(grey([1.0]), scales=np.array([[64.0, 0.0, 0.0]]))
    out = render(needle, dyadic_camera(9, 9))
    np.testing.assert_allclose(out.splats.conics[0], [1.0 / (4096.0 + 0.3), 0.0, 1.0 / 0.3], rtol=1e-12)
    assert np.all(out.n_blended[4] == 1)
    # exp(-d^2 / 0.6) falls under 1/255 between 1 and 2 px
    assert out.n_blended[:, 4].tolist() == [0, 0, 0, 1, 1, 1, 0, 0, 0]


def test_a_gaussian_of_no_size_is_the_low_pass_itself() -> None:
    out = render(grey([1.0], scale=0.0), dyadic_camera(5, 5))
    np.testing.assert_allclose(out.splats.conics[0], [1.0 / 0.3, 0.0, 1.0 / 0.3], rtol=1e-14)
    assert np.sum(out.n_blended) == 9


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


def test_a_degree_beyond_the_coefficients_is_refused() -> None:
    with pytest.raises(ValueError, match="sh has 4 coefficients; sh_degree 3 needs 16"):
        render(random_gaussians(0), tilted_camera(), sh_degree=3)


def test_renders_are_values_that_repeat_bit_for_bit_and_leave_their_arguments_alone() -> None:
    gaussians, view = random_gaussians(6, 8), tilted_camera()
    before = [a.copy() for a in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)]
    one, two = render(gaussians, view, BACKGROUND), render(gaussians, view, BACKGROUND)
    assert np.array_equal(one.image, two.image)
    after = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_camera_inside_the_cloud_renders_without_a_warning() -> None:
    gaussians = replace(random_gaussians(7, 12), means=np.random.default_rng(7).normal(size=(12, 3)))
    view = Camera(np.eye(4), camera().K, 6, 5)
    out = render(gaussians, view)
    assert 0 < np.sum(out.splats.visible) < 12
    assert np.all(np.isfinite(out.image))
