"""Passes over views: every backend against the oracle, and what the front end promises."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from torch import Tensor

from pop_fast import compiled
from pop_fast.density.passes import Passes, ViewContributions
from pop_fast.errors import PopError
from pop_fast.stages.density import pixel_weights
from pop_fast.train import TrainConfig
from pop_fast.train.views import render_view
from pop_ref.constants import PROFILES
from pop_ref.fisher import log_det_scores
from pop_ref.records import Camera, Gaussians
from tests.fast.pass_scenes import HEIGHT, WIDTH, raw_params, views

BACKENDS = [
    "fast",
    pytest.param("compiled", marks=pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")),
]
BACKGROUND = (0.2, 0.4, 0.1)


def passes(backend: str, profile: str = "paper", dtype: torch.dtype = torch.float64, **more) -> Passes:
    return Passes(backend, views(dtype), profile, BACKGROUND, **more)


def assert_as_in(expected: Tensor, found: Tensor, tolerance: float = 1e-10) -> None:
    size = float(expected.abs().max())
    assert size > 0.0
    torch.testing.assert_close(found, expected, rtol=0.0, atol=tolerance * size)


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_contributions_are_the_oracles(backend: str, profile: str, index: int) -> None:
    pixel_map = torch.rand(HEIGHT, WIDTH, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    expected, found = (
        passes(name, profile).contributions(raw_params(), index, 3, pixel_map) for name in ("ref", backend)
    )
    for name in ("weight_sum", "map_sum", "distance_sum", "image"):
        assert_as_in(getattr(expected, name), getattr(found, name))
    for name in ("n_pixels", "dominant_counts", "radii", "visible"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert_as_in(expected.depths[expected.visible], found.depths[expected.visible])
    assert not bool(found.visible.all())


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_antialiased_contributions_are_the_oracles(backend: str, profile: str) -> None:
    expected, found = (
        passes(name, profile, antialiased=True).contributions(raw_params(), 0, 1) for name in ("ref", backend)
    )
    assert_as_in(expected.weight_sum, found.weight_sum)
    assert torch.equal(found.n_pixels, expected.n_pixels)
    assert not bool(found.map_sum.any())


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_sensitivities_are_the_oracles(backend: str, profile: str) -> None:
    expected, found = (passes(name, profile).sensitivities(raw_params(), 1, 2) for name in ("ref", backend))
    assert_as_in(expected, found)


@pytest.mark.parametrize("divisor", [1, 4])
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_fisher_blocks_are_the_oracles(backend: str, profile: str, divisor: int) -> None:
    expected, found = (passes(name, profile).fisher(raw_params(), 1, 3, divisor) for name in ("ref", backend))
    # parameters differ in unit: every entry against the roots of its row's and column's
    sizes = expected.diagonal(dim1=1, dim2=2).sqrt()
    units = sizes[:, :, None] * sizes[:, None, :]
    assert int((units > 0.0).all(2).all(1).sum()) > 20
    assert float(((found - expected).abs() - 1e-10 * units).max()) <= 0.0
    assert torch.equal(found, found.transpose(1, 2))


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("backend", BACKENDS)
def test_dominant_points_are_the_oracles(backend: str, profile: str) -> None:
    params = raw_params()
    # a wide and flat one that is seen from its edge, so that it lies behind some rays; and one without thickness
    params["means"][2], params["scales"][2] = torch.tensor([0.1, 0.0, 0.5]), torch.tensor([0.0, 0.0, -4.0])
    params["quats"][2], params["opacities"][2] = torch.tensor([0.7, 0.0, 0.7, 0.05]), torch.tensor(0.5)
    params["scales"][22, 0] = -torch.inf
    expected, found = (passes(name, profile).dominant_points(params, 0, 3) for name in ("ref", backend))
    assert_as_in(expected[0], found[0])
    assert torch.equal(found[1], expected[1])
    assert_as_in(expected[2], found[2])
    drawn = passes("ref", profile)._open(passes("ref", profile)._shot(params, 0, 3)).seen().dominant_ids
    assert len(expected[1].unique()) > 10
    assert int((expected[1] != drawn).sum()) > 100
    assert 22 in drawn
    assert 22 not in expected[1]


@pytest.mark.parametrize("backend", BACKENDS)
def test_in_float32_the_same_pixels_count(backend: str) -> None:
    double, single = (
        passes(backend, dtype=dtype).contributions(raw_params(dtype=dtype), 0, 3)
        for dtype in (torch.float64, torch.float32)
    )
    assert torch.equal(single.n_pixels, double.n_pixels)
    assert torch.equal(single.dominant_counts, double.dominant_counts)
    assert {f.name: getattr(single, f.name).dtype for f in fields(ViewContributions)} == {
        **dict.fromkeys(("weight_sum", "map_sum", "distance_sum"), torch.float64),
        **dict.fromkeys(("n_pixels", "dominant_counts"), torch.int64),
        **dict.fromkeys(("image", "depths"), torch.float32),
        "radii": torch.int32,
    }


@pytest.mark.parametrize("backend", BACKENDS)
def test_weights_and_remaining_light_sum_to_one(backend: str) -> None:
    made = passes(backend)
    weights = made.contributions(raw_params(), 0, 0).weight_sum.sum()
    left = made.dominant_points(raw_params(), 0, 0)[2].sum()
    torch.testing.assert_close(weights + left, torch.tensor(float(WIDTH * HEIGHT), dtype=torch.float64))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("profile", ["paper", "inria"])
def test_a_pass_draws_what_a_training_draws(backend: str, profile: str) -> None:
    from pop_fast.api.backend import get_backend

    config = TrainConfig(profile=profile, background=BACKGROUND)
    found = Passes.of(get_backend(backend), views(), config).contributions(raw_params(), 1, 2)
    drawn = render_view(get_backend(backend), raw_params(), views()[1], config, 2, dominance=True)
    torch.testing.assert_close(found.image, drawn.image, rtol=0.0, atol=1e-14)
    assert torch.equal(found.dominant_counts, drawn.info["dominant_counts"][0])
    assert torch.equal(found.radii, drawn.info["radii"][0])


def test_pixels_that_the_mask_ignores_dominate_nothing() -> None:
    masked = passes("fast").contributions(raw_params(), 1, 0)
    mask = views()[1].mask
    assert mask is not None
    assert 0 < int(masked.dominant_counts.sum()) <= int(mask.sum())


def test_a_map_may_be_made_of_the_image() -> None:
    made = passes("fast")
    image = made.image(raw_params(), 0, 3)
    expected = made.contributions(raw_params(), 0, 3, pixel_weights(image, made.photo(0)))
    found = made.contributions(raw_params(), 0, 3, lambda image: pixel_weights(image, made.photo(0)))
    assert float(expected.map_sum.max()) > 0.0
    assert torch.equal(found.map_sum, expected.map_sum)


def test_a_smaller_view_keeps_the_field_of_view() -> None:
    shot = passes("fast")._shot(raw_params(), 0, 3, divisor=4)
    camera, K = shot.camera, views()[0].K[0]
    assert (camera.width, camera.height) == (10, 6)
    for at, small, large in ((0, camera.width, WIDTH), (1, camera.height, HEIGHT)):
        torch.testing.assert_close(small / camera.K[at, at], large / K[at, at])
        torch.testing.assert_close(camera.K[at, 2] / small, K[at, 2] / large)


def test_fisher_blocks_are_sums_of_outer_products_of_derivatives() -> None:
    # by differences of the oracle's images, a pixel and a channel at a time
    from pop_ref.render import render

    made = passes("fast")
    shot = made._shot(raw_params(12), 0, 2, divisor=4)
    g, c = shot.gaussians, shot.camera
    arrays = [t.numpy() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    camera = Camera(c.viewmat.numpy(), c.K.numpy(), c.width, c.height)

    def drawn(i: int, k: int, step: float) -> np.ndarray:
        means, scales = arrays[0].copy(), arrays[2].copy()
        if k < 3:
            means[i, k] += step
        else:
            scales[i, k - 3] *= np.exp(step)
        moved = Gaussians(means, arrays[1], scales, *arrays[3:])
        return render(moved, camera, background=np.array(BACKGROUND), sh_degree=2).image

    found = made.fisher(raw_params(12), 0, 2).numpy()
    i = int(np.argmax(np.linalg.norm(found, axis=(1, 2))))
    step = 1e-5
    slopes = np.stack([(drawn(i, k, step) - drawn(i, k, -step)).ravel() / (2.0 * step) for k in range(6)])
    np.testing.assert_allclose(found[i], slopes @ slopes.T, rtol=1e-4, atol=1e-4 * np.max(np.abs(found[i])))


def test_scores_of_blocks_are_the_oracles() -> None:
    from pop_fast.stages.contributions import log_det_scores as in_torch

    made = passes("fast")
    one = made.fisher(raw_params(), 0, 3)
    both = one + made.fisher(raw_params(), 1, 3)
    both[5] = 0.0
    expected, found = log_det_scores(both.numpy()), in_torch(both).numpy()
    assert np.isneginf(expected[5])
    assert np.array_equal(np.isneginf(found), np.isneginf(expected))
    assert int(np.isfinite(expected).sum()) > 20
    np.testing.assert_allclose(found[np.isfinite(expected)], expected[np.isfinite(expected)], atol=1e-6)


def test_what_cannot_be_is_said() -> None:
    with pytest.raises(PopError, match="antialiased=False"):
        passes("fast", antialiased=True).fisher(raw_params(), 0, 3)
    with pytest.raises(PopError, match="unknown"):
        passes("fats")
    with pytest.raises(ValueError, match=r"pixel_map has shape \[3, 3\]"):
        passes("fast").contributions(raw_params(), 0, 3, torch.zeros(3, 3))


def test_views_are_counted_and_their_photographs_are_theirs() -> None:
    made = passes("fast")
    assert made.n_views == 2
    assert torch.equal(made.photo(1), views()[1].photo)
    assert made.view(1).name == "second"
