"""The first Gaussians: one a point, as large as its neighbourhood."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pop_fast.data import Capture, View, initialize_params
from tests.app.captures import assert_one_line, cloud, photograph, ring


def some_capture(points: np.ndarray, rgb: np.ndarray | None = None) -> Capture:
    views = tuple(View(f"{i}.png", photograph(i), viewmat, np.eye(3)) for i, viewmat in enumerate(ring(3)))
    colors = np.zeros((len(points), 3), np.uint8) if rgb is None else rgb
    return Capture("scene", views, np.asarray(points, np.float64), colors, "test")


def test_sizes_are_the_root_mean_square_distance_to_the_three_nearest_neighbours() -> None:
    points, rgb = cloud(30)
    params = initialize_params(some_capture(points, rgb), dtype=torch.float64)
    for i, point in enumerate(points):
        nearest = np.sort(np.linalg.norm(points - point, axis=1))[1:4]
        want = math.log(math.sqrt(np.mean(nearest**2)))
        assert params["scales"][i].tolist() == pytest.approx([want] * 3, rel=1e-12)
    wider = initialize_params(some_capture(points, rgb), init_scale=2.0, dtype=torch.float64)
    assert torch.allclose(wider["scales"], params["scales"] + math.log(2.0))


def test_colours_places_and_opacities_are_those_of_the_points() -> None:
    points, rgb = cloud(10)
    params = initialize_params(some_capture(points, rgb), init_opacity=0.25)
    assert {name: tuple(value.shape) for name, value in params.items()} == {
        "means": (10, 3),
        "scales": (10, 3),
        "quats": (10, 4),
        "opacities": (10,),
        "sh0": (10, 1, 3),
        "shN": (10, 15, 3),
    }
    assert all(value.dtype == torch.float32 for value in params.values())
    assert np.allclose(params["means"].numpy(), points, atol=1e-6)
    assert torch.allclose(torch.sigmoid(params["opacities"]), torch.tensor(0.25))
    shown = 0.5 + 0.28209479177387814 * params["sh0"][:, 0]
    assert np.allclose(shown.numpy() * 255.0, rgb, atol=1e-3)
    assert not params["shN"].any()


def test_rotations_are_uniform_in_the_unit_cube_and_follow_the_seed() -> None:
    capture = some_capture(cloud(2000)[0])
    first, again, other = (initialize_params(capture, seed)["quats"] for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0.0
    assert first.max() < 1.0
    assert torch.allclose(first.mean(dim=0), torch.tensor(0.5), atol=0.03)


def test_points_that_coincide_and_single_points_get_a_finite_size() -> None:
    same = some_capture(np.zeros((5, 3)))
    floor = math.log(math.sqrt(1e-7) * same.scene_scale())
    for capture in (same, some_capture(np.zeros((1, 3)))):
        assert initialize_params(capture)["scales"].flatten().tolist() == pytest.approx(
            [floor] * (3 * len(capture.points)), rel=1e-6
        )


def test_fewer_than_four_points_use_the_neighbours_there_are() -> None:
    params = initialize_params(some_capture(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])), dtype=torch.float64)
    assert params["scales"].exp().flatten().tolist() == pytest.approx([2.0] * 6)


def test_a_capture_without_points_and_an_impossible_opacity_are_refused() -> None:
    capture = some_capture(cloud(4)[0])
    empty = replace(capture, points=np.zeros((0, 3)), points_rgb=np.zeros((0, 3), np.uint8))
    assert_one_line(lambda: initialize_params(empty), "scene", "no points")
    assert_one_line(lambda: initialize_params(capture, init_opacity=1.0), "init_opacity", "between 0 and 1")
