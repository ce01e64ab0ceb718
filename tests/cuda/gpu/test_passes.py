"""Passes over views on the GPU against the CPU's in float64, and their bits from run to run."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from pop_fast.density.passes import Passes, ViewContributions
from pop_ref.constants import PROFILES
from tests.fast.pass_scenes import HEIGHT, WIDTH, raw_params, views

BACKGROUND = (0.2, 0.4, 0.1)


def on_both(gpu: Any, profile: str = "paper", n: int = 60, **more: Any) -> tuple[list[Any], list[Any]]:
    """Return passes and parameters, of the CPU in float64 and of the GPU."""
    moved = {name: value.to(gpu) for name, value in raw_params(n, torch.float32).items()}
    cpu = Passes("fast", views(), profile, BACKGROUND, **more)
    cuda = Passes("cuda", views(torch.float32), profile, BACKGROUND, device=gpu, **more)
    return [cpu, {name: value.double().cpu() for name, value in moved.items()}], [cuda, moved]


def apart(expected: Tensor, found: Tensor, columns: bool = False) -> float:
    """Return the largest difference by the largest value, of every column where these have units of their own."""
    expected, found = expected.double(), found.double().cpu()
    size = expected.abs().amax(0) if columns else expected.abs().max()
    assert float(size.min()) > 0.0
    return float(((found - expected).abs() / size).max())


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("index", [0, 1])
def test_contributions_are_the_cpus(gpu: Any, profile: str, index: int) -> None:
    pixel_map = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(3))
    (cpu, params), (cuda, moved) = on_both(gpu, profile)
    expected = cpu.contributions(params, index, 3, pixel_map)
    found = cuda.contributions(moved, index, 3, pixel_map.to(gpu))
    for name in ("weight_sum", "map_sum", "distance_sum", "image"):
        assert apart(getattr(expected, name), getattr(found, name)) < 5e-6, name
    for name in ("n_pixels", "dominant_counts", "radii", "visible"):
        assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name


def test_antialiased_contributions_are_the_cpus(gpu: Any) -> None:
    (cpu, params), (cuda, moved) = on_both(gpu, antialiased=True)
    expected, found = cpu.contributions(params, 0, 0), cuda.contributions(moved, 0, 0)
    assert apart(expected.weight_sum, found.weight_sum) < 5e-6
    assert torch.equal(found.n_pixels.cpu(), expected.n_pixels)
    assert not bool(found.map_sum.any())


@pytest.mark.parametrize("profile", PROFILES)
def test_sensitivities_are_the_cpus(gpu: Any, profile: str) -> None:
    (cpu, params), (cuda, moved) = on_both(gpu, profile)
    assert apart(cpu.sensitivities(params, 1, 2), cuda.sensitivities(moved, 1, 2)) < 5e-6


@pytest.mark.parametrize("profile", PROFILES)
def test_moments_and_fisher_blocks_are_the_cpus(gpu: Any, profile: str) -> None:
    (cpu, params), (cuda, moved) = on_both(gpu, profile)
    of_cpu, of_cuda = (p._open(p._shot(rows, 0, 3)) for p, rows in ((cpu, params), (cuda, moved)))
    assert apart(of_cpu._moments(), of_cuda._view.screen_moments(), columns=True) < 2e-5
    expected, found = cpu.fisher(params, 0, 3, 2), cuda.fisher(moved, 0, 3, 2).cpu()
    sizes = expected.diagonal(dim1=1, dim2=2).sqrt()
    units = sizes[:, :, None] * sizes[:, None, :]
    assert int((units > 0.0).all(2).all(1).sum()) > 20
    assert float(((found - expected).abs() - 2e-4 * units).max()) <= 0.0


@pytest.mark.parametrize("profile", PROFILES)
def test_dominant_points_are_the_cpus(gpu: Any, profile: str) -> None:
    (cpu, params), (cuda, moved) = on_both(gpu, profile)
    for rows in (params, moved):
        # seen from its edge, so that it lies behind some rays
        rows["means"][2], rows["scales"][2] = torch.tensor([0.1, 0.0, 0.5]), torch.tensor([0.0, 0.0, -4.0])
        rows["quats"][2], rows["opacities"][2] = torch.tensor([0.7, 0.0, 0.7, 0.05]), torch.tensor(0.5)
    (points, ids, T_final), found = cpu.dominant_points(params, 0, 3), cuda.dominant_points(moved, 0, 3)
    assert torch.equal(found[1].cpu(), ids)
    assert apart(points, found[0]) < 5e-6
    assert apart(T_final, found[2]) < 5e-6
    drawn = cuda._open(cuda._shot(moved, 0, 3)).seen().dominant_ids.cpu()
    assert int((drawn != ids).sum()) > 100


def test_every_run_gives_the_same_bits(gpu: Any) -> None:
    _, (cuda, moved) = on_both(gpu, n=400)

    def found() -> list[Tensor]:
        view = cuda._open(cuda._shot(moved, 0, 3))
        sums = view.contributions(torch.ones(HEIGHT, WIDTH, device=gpu))
        names = ("weight_sum", "n_pixels", "map_sum", "distance_sum")
        return [*(getattr(sums, name) for name in names), view.sensitivities(), view._view.screen_moments()]

    first = found()
    assert all(torch.equal(a, b) for _ in range(2) for a, b in zip(first, found(), strict=True))


def test_weights_and_remaining_light_sum_to_one(gpu: Any) -> None:
    _, (cuda, moved) = on_both(gpu, n=400)
    weights = cuda.contributions(moved, 0, 0).weight_sum.sum()
    left = cuda.dominant_points(moved, 0, 0)[2].double().sum()
    torch.testing.assert_close(float(weights + left), float(WIDTH * HEIGHT), rtol=1e-6, atol=0.0)


def test_nobody_contributes_to_a_view_that_shows_nobody(gpu: Any) -> None:
    _, (cuda, moved) = on_both(gpu)
    moved["means"][:, 2] -= 100.0
    found: ViewContributions = cuda.contributions(moved, 0, 3)
    assert not bool(found.n_pixels.any())
    assert not bool(cuda.sensitivities(moved, 0, 3).any())
    assert not bool(cuda.fisher(moved, 0, 3).any())
    points, ids, T_final = cuda.dominant_points(moved, 0, 3)
    assert bool((ids == -1).all())
    assert not bool(points.any())
    assert bool((T_final == 1.0).all())
