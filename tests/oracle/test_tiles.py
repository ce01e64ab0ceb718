"""Tile lists against brute force over pixels, and their order."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize, minimize_scalar

from pop_ref import GSPLAT_1_6, INRIA, PAPER, SPEEDY_SPLAT, Camera, Gaussians, Profile, project, render, tiles
from pop_ref.chord import chord_midpoint, dominant_points
from pop_ref.compositing import composite
from pop_ref.tight_tiles import accutile, snug_box, tight_tile_lists
from pop_ref.tiles import tile_lists, tile_rects
from tests.oracle.dense import blended_pixels, rotations
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera

quarter_px = st.integers(-40, 120).map(lambda k: k / 4.0)
radius = st.integers(1, 9)


@given(quarter_px, quarter_px, radius, radius, st.sampled_from([1, 3, 4, 16]))
def test_a_rectangle_holds_every_pixel_within_the_extent(u: float, v: float, r_x: int, r_y: int, size: int) -> None:
    width, height = 17, 13
    rect = tiles.tile_rects(np.array([[u, v]]), np.array([[r_x, r_y]]), width, height, size)[0].tolist()
    for y in range(height):
        for x in range(width):
            if abs(x + 0.5 - u) <= r_x and abs(y + 0.5 - v) <= r_y:
                assert rect[0] <= x // size < rect[2]
                assert rect[1] <= y // size < rect[3]


@given(quarter_px, radius, st.sampled_from([1, 4, 16]))
def test_a_rectangle_holds_only_tiles_that_the_extent_overlaps(u: float, r: int, size: int) -> None:
    x0, _, x1, _ = tiles.tile_rects(np.array([[u, 4.0]]), np.array([[r, r]]), 17, 13, size)[0].tolist()
    tiles_x, _ = tiles.grid_size(17, 13, size)
    overlapped = [k for k in range(tiles_x) if u - r < (k + 1) * size and u + r > k * size]
    assert list(range(x0, x1)) == overlapped


@given(quarter_px, radius, st.sampled_from([4, 16]))
def test_inria_s_rectangle_is_what_its_integer_arithmetic_gives(u: float, r: int, size: int) -> None:
    x0, _, x1, _ = tiles.tile_rects(np.array([[u, 4.0]]), np.array([[r, r]]), 17, 13, size, INRIA)[0].tolist()
    tiles_x, _ = tiles.grid_size(17, 13, size)
    # in index space, where pixel j lies at j; numpy's int cast truncates toward zero
    p = u - 0.5
    want = [np.trunc((p - r) / size), np.trunc((p + r + size - 1) / size)]
    assert [x0, x1] == [int(min(max(k, 0), tiles_x)) for k in want]


def test_inria_s_rectangle_can_miss_a_pixel_within_the_extent() -> None:
    # the square's last pixel column is cut: p + r + t - 1 = 8 + 3.75 + 4 - 1 truncates to tile 3
    means2d, radii = np.array([[8.25, 8.0]]), np.array([[4, 4]])
    paper = tiles.tile_rects(means2d, radii, 16, 16, 4)[0].tolist()
    inria = tiles.tile_rects(means2d, radii, 16, 16, 4, INRIA)[0].tolist()
    assert (paper[2], inria[2]) == (4, 3)


def test_lists_are_row_major_and_hold_what_overlaps() -> None:
    means2d, radii = np.array([[1.0, 1.0], [5.0, 5.0], [3.0, 3.0]]), np.full((3, 2), 2)
    got = tiles.tile_lists(means2d, radii, np.array([1.0, 2.0, 3.0]), 8, 8, 4)
    assert got == [[0, 1, 2], [1, 2], [1, 2], [1, 2]]


def test_a_culled_splat_is_in_no_list() -> None:
    assert tiles.tile_lists(np.array([[2.0, 2.0]]), np.array([[0, 0]]), np.ones(1), 4, 4, 4) == [[]]


def test_no_splats_make_empty_lists_and_the_last_tiles_may_be_partial() -> None:
    assert tiles.grid_size(1, 1, 16) == (1, 1)
    assert tiles.grid_size(33, 16, 16) == (3, 1)
    empty = np.zeros((0, 2))
    assert tiles.tile_lists(empty, empty.astype(np.int64), np.zeros(0), 33, 17, 16) == [[]] * 6


def test_a_tile_size_of_zero_is_refused() -> None:
    with pytest.raises(ValueError, match="tile_size is 0; it must be >= 1"):
        tiles.grid_size(4, 4, 0)


# Exact tile lists: every tile tested by itself, and images that do not change.

W, H, SIZE = 40, 32, 4


def least_exponent(mean2d, conic, left: float, top: float, right: float, bottom: float) -> float:
    """Minimise sigma over a closed rectangle: inside it, or on its four edges, each a parabola."""
    A, B, C = conic
    u, v = mean2d
    if left <= u <= right and top <= v <= bottom:
        return 0.0
    found = []
    for x in (left, right):
        dx = x - u
        dy = min(max(-B * dx / C, top - v), bottom - v)
        found.append(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy)
    for y in (top, bottom):
        dy = y - v
        dx = min(max(-B * dy / A, left - u), right - u)
        found.append(0.5 * (A * dx * dx + C * dy * dy) + B * dx * dy)
    return min(found)


def random_splats(seed: int, n: int = 60):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, 2, 2)) * np.exp(rng.normal(size=(n, 2, 1)) * 1.2)
    covars = A @ np.swapaxes(A, 1, 2) + 0.3 * np.eye(2)
    inverse = np.linalg.inv(covars)
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)
    means2d = rng.uniform(-6.0, [W + 6.0, H + 6.0], size=(n, 2))
    opacities = rng.choice([1.0, 0.5, 0.02, 0.0041, 0.0039], size=n)
    return means2d, covars, conics, opacities, rng.uniform(1.0, 9.0, n)


@pytest.mark.parametrize("seed", range(4))
def test_the_box_is_that_of_the_ellipse(seed: int) -> None:
    means2d, covars, conics, opacities, _ = random_splats(seed)
    for i in range(len(opacities)):
        box = snug_box(means2d[i], conics[i], float(opacities[i]))
        if opacities[i] < PAPER.alpha_floor:
            assert box is None
            continue
        assert box is not None
        # its rim, sampled: mean + sqrt(t) L (cos, sin)
        t = 2.0 * math.log(opacities[i] * 255.0)
        angles = np.linspace(0.0, 2.0 * np.pi, 100_001)
        circle = np.stack([np.cos(angles), np.sin(angles)])
        rim = means2d[i][:, None] + math.sqrt(t) * np.linalg.cholesky(covars[i]) @ circle
        want = [*np.min(rim, axis=1), *np.max(rim, axis=1)]
        np.testing.assert_allclose(box, want, atol=1e-6)


def test_the_minimum_over_a_rectangle_is_the_minimum() -> None:
    # the reference of the tests below, against a minimiser
    means2d, _, conics, _, _ = random_splats(9, 20)
    for mean2d, (A, B, C) in zip(means2d, conics, strict=True):
        box = [(4.0, 9.0), (8.0, 10.0)]
        found = minimize(
            lambda p, u=mean2d, q=(A, B, C): (
                0.5 * (q[0] * (p[0] - u[0]) ** 2 + q[2] * (p[1] - u[1]) ** 2) + q[1] * (p[0] - u[0]) * (p[1] - u[1])
            ),
            x0=[6.0, 9.0],
            bounds=box,
            method="L-BFGS-B",
            options={"ftol": 1e-15, "gtol": 1e-10},
        )
        least = least_exponent(mean2d, (A, B, C), 4.0, 8.0, 9.0, 10.0)
        assert least == pytest.approx(found.fun, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("profile", [PAPER, SPEEDY_SPLAT, INRIA], ids=lambda p: p.name)
def test_exactly_the_tiles_that_the_ellipse_meets_are_kept(seed: int, profile: Profile) -> None:
    means2d, _, conics, opacities, _ = random_splats(seed)
    rect = (0, 0, W // SIZE, H // SIZE)
    some = 0
    for i in range(len(opacities)):
        kept = accutile(means2d[i], conics[i], float(opacities[i]), rect, SIZE, profile)
        assert kept == sorted(set(kept), key=lambda tile: tile[::-1])
        for x in range(rect[2]):
            for y in range(rect[3]):
                edges = (x * SIZE, y * SIZE, (x + 1) * SIZE, (y + 1) * SIZE)
                brightest = opacities[i] * math.exp(-least_exponent(means2d[i], conics[i], *edges))
                # random numbers do not touch; one that did would be decided by rounding
                assert abs(brightest / profile.alpha_floor - 1.0) > 1e-9
                assert ((x, y) in kept) == (brightest >= profile.alpha_floor)
        some += 0 < len(kept) < rect[2] * rect[3]
    assert some > 20


def test_only_tiles_of_the_rectangle_are_given() -> None:
    means2d, _, conics, _, _ = random_splats(2)
    for i in range(20):
        inside = accutile(means2d[i], conics[i], 1.0, (2, 1, 6, 5), SIZE)
        whole = accutile(means2d[i], conics[i], 1.0, (0, 0, 10, 8), SIZE)
        assert inside == [(x, y) for x, y in whole if 2 <= x < 6 and 1 <= y < 5]


def test_a_conic_without_an_ellipse_gets_the_whole_rectangle() -> None:
    for conic in ([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 2.0, 1.0]):
        assert len(accutile(np.array([9.0, 9.0]), np.array(conic), 1.0, (1, 1, 3, 4), SIZE)) == 6
    assert accutile(np.array([9.0, 9.0]), np.array([1.0, 0.0, 1.0]), 0.003, (0, 0, 4, 4), SIZE) == []


def test_an_ellipse_that_is_a_point_is_in_its_tile() -> None:
    # at the floor itself nothing but the centre is left; in profile inria it is listed, and blended at the centre
    tiles = accutile(np.array([9.5, 6.5]), np.array([1.0, 0.0, 1.0]), INRIA.alpha_floor, (0, 0, 4, 4), SIZE, INRIA)
    assert tiles == [(2, 1)]


@pytest.mark.parametrize("profile", [PAPER, GSPLAT_1_6, SPEEDY_SPLAT, INRIA], ids=lambda p: p.name)
@pytest.mark.parametrize("size", [16, 4, 1])
def test_images_are_the_same_to_the_bit_and_lists_are_parts_of_the_rectangles(profile: Profile, size: int) -> None:
    shorter = 0
    for seed in range(6):
        for view in (camera(19, 13, 16.0), tilted_camera(17, 20, 16.0)):
            gaussians = random_gaussians(seed, 14)
            # needles, points and splats at and under the floor as well
            scales = gaussians.scales * np.array([[1.0, 0.05, 0.05]])
            opacities = np.where(np.arange(14) % 4 == 1, 1.0 / 255.0, gaussians.opacities)
            opacities = np.where(np.arange(14) % 7 == 2, 0.0038, opacities)
            gaussians = type(gaussians)(gaussians.means, gaussians.quats, scales, opacities, gaussians.sh)
            s = project(gaussians, view, profile=profile)
            args = (view.width, view.height, size, profile)
            wide = tile_lists(s.means2d, s.radii, s.depths, *args)
            tight = tight_tile_lists(s.means2d, s.conics, s.opacities, s.radii, s.depths, *args)
            for few, many in zip(tight, wide, strict=True):
                assert few == [i for i in many if i in few]
            shorter += sum(map(len, tight)) < sum(map(len, wide))
            background = np.array([0.25, 0.5, 1.0])
            one, other = (composite(s, lists, *args[:3], background, profile) for lists in (tight, wide))
            for name in ("image", "T_final", "dominant_ids", "dominant_weights", "n_blended"):
                assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert shorter > 3


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


@given(st.data(), st.sampled_from([1, 2, 4, 16]))
def test_no_pixel_that_sees_a_splat_lies_outside_its_tiles(data, size: int) -> None:
    quarter = st.integers(-64, 160).map(lambda k: k / 4.0)
    u, v = data.draw(quarter), data.draw(quarter)
    a, c = (data.draw(st.sampled_from([0.3, 1.0, 4.3, 25.3, 400.3])) for _ in range(2))
    b = data.draw(st.sampled_from([0.0, 0.5, -0.9, 0.999999, -0.999999])) * math.sqrt(a * c)
    det = a * c - b * b
    assume(det > 0.0)
    conic = np.array([c / det, -b / det, a / det])
    opacity = data.draw(st.sampled_from([1.0, 0.5, 1.0 / 255.0, 0.004, 0.003, 1.0 / 128.0]))
    kept = set(accutile(np.array([u, v]), conic, opacity, (0, 0, -(-24 // size), -(-24 // size)), size, INRIA))
    for y in range(24):
        for x in range(24):
            dx, dy = u - (x + 0.5), v - (y + 0.5)
            sigma = 0.5 * (conic[0] * dx * dx + conic[2] * dy * dy) + conic[1] * dx * dy
            if sigma >= 0.0 and opacity * math.exp(-sigma) >= INRIA.alpha_floor:
                assert (x // size, y // size) in kept


# Points on rays: the densest point found by search, the chord's middle by its ends, each pixel by its list.


def exponent(t: float, mean: np.ndarray, precision: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> float:
    d = origin + t * direction - mean
    return float(0.5 * d @ precision @ d)


@pytest.mark.parametrize("seed", range(8))
def test_the_midpoint_is_where_the_density_is_greatest_and_halves_the_chord(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, quat, scale = rng.normal(size=3), rng.normal(size=4), np.exp(rng.normal(size=3))
    origin, direction = rng.normal(size=3) * 3.0, rng.normal(size=3)
    R = rotations(quat[None])[0]
    precision = R @ np.diag(scale**-2.0) @ R.T
    t = chord_midpoint(mean, quat, scale, origin, direction)
    args = (mean, precision, origin, direction)
    found = minimize_scalar(exponent, args=args, bracket=(-1.0, 1.0), tol=1e-12)
    assert t == pytest.approx(found.x, abs=1e-5 * (1.0 + abs(t)))
    # roots of |a + t b|^2 = k^2 for any k that the ray reaches
    least = exponent(t, *args)
    b2 = float(direction @ precision @ direction)
    for k2 in (2.0 * least + 1.0, 2.0 * least + 9.0):
        ab = float(direction @ precision @ (origin - mean))
        a2 = float((origin - mean) @ precision @ (origin - mean))
        ends = np.roots([b2, 2.0 * ab, a2 - k2])
        assert t == pytest.approx(float(np.mean(ends)), rel=1e-9, abs=1e-9)


def test_a_round_gaussian_has_the_foot_of_the_perpendicular() -> None:
    t = chord_midpoint(np.array([1.0, 2.0, 4.0]), np.ones(4), np.full(3, 0.5), np.zeros(3), np.array([0.0, 0.0, 2.0]))
    assert t == pytest.approx(2.0)


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


def leaning(opacity: float) -> Gaussians:
    """A long Gaussian whose centre is just ahead, slanted so that the ray through the middle is densest behind."""
    half = np.pi / 8.0
    behind = Gaussians(
        means=np.array([[0.25, 0.0, 0.125]]),
        quats=np.array([[np.cos(half), 0.0, np.sin(half), 0.0]]),
        scales=np.array([[0.05, 0.05, 4.0]]),
        opacities=np.array([opacity]),
        sh=np.zeros((1, 1, 3)),
    )
    ahead = grey([0.25])
    return Gaussians(
        *(
            np.concatenate([getattr(behind, n), getattr(ahead, n)])
            for n in ("means", "quats", "scales", "opacities", "sh")
        )
    )


def test_a_gaussian_that_is_densest_behind_the_camera_is_blended_but_does_not_compete() -> None:
    view = dyadic_camera(5, 5)
    gaussians = leaning(0.9)
    drawn, points, ids, _ = points_by_list(gaussians, view, PAPER, 16)
    found = dominant_points(drawn.splats, drawn.tile_lists, gaussians, view, 16)
    differ = (drawn.dominant_ids == 0) & (found.ids != 0)
    assert np.any(differ), "nowhere does a Gaussian dominate from behind: this test would say nothing"
    assert np.array_equal(found.ids, ids)
    np.testing.assert_allclose(found.points, points, rtol=1e-9, atol=1e-12)
    assert np.array_equal(found.T_final, drawn.T_final)


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
