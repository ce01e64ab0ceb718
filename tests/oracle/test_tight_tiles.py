"""Exact tile lists: every tile tested by itself, and images that do not change."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from pop_ref import GSPLAT_1_6, INRIA, PAPER, SPEEDY_SPLAT, Profile, project
from pop_ref.compositing import composite
from pop_ref.tight_tiles import accutile, snug_box, tight_tile_lists
from pop_ref.tiles import tile_lists, tile_rects
from tests.oracle.scenes import camera, random_gaussians, tilted_camera

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
