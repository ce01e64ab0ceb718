"""Points on rays: the densest point found by search, the chord's middle by its ends, each pixel by its list."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from pop_ref import INRIA, PAPER, Camera, Gaussians, Profile, render
from pop_ref.chord import chord_midpoint, dominant_points
from tests.oracle.by_definition import blended_pixels
from tests.oracle.dense import rotations
from tests.oracle.scenes import camera, dyadic_camera, grey, random_gaussians, tilted_camera


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
