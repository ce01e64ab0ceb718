"""A splat moved into another frame is the same splat."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pop_fast.activations import scales_from_log_scales
from pop_fast.covariance import covars_from_quats_scales
from pop_fast.harmonics import colors_from_sh
from pop_fast.world import move_params


def similarity(seed: int, scale: float) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * Rotation.random(random_state=rng).as_matrix()
    matrix[:3, 3] = rng.normal(size=3)
    return torch.tensor(matrix)


def splat(seed: int, n: int = 5, bands: int = 15) -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (bands, 3)}
    return {name: torch.randn((n, *shape), generator=rng, dtype=torch.float64) for name, shape in shapes.items()}


@given(st.integers(0, 999), st.sampled_from([0.25, 1.0, 3.0]))
def test_covariances_of_a_moved_splat_are_conjugated(seed: int, scale: float) -> None:
    params, transform = splat(seed), similarity(seed, scale)
    moved = move_params(params, transform)
    before = covars_from_quats_scales(params["quats"], scales_from_log_scales(params["scales"]))
    after = covars_from_quats_scales(moved["quats"], scales_from_log_scales(moved["scales"]))
    linear = transform[:3, :3]
    torch.testing.assert_close(after, linear @ before @ linear.T, rtol=1e-9, atol=1e-12)


@given(st.integers(0, 999), st.sampled_from([0, 3, 8, 15]))
def test_colours_seen_from_a_moved_direction_stay_the_same(seed: int, bands: int) -> None:
    params, transform = splat(seed, bands=bands), similarity(seed, 2.0)
    moved = move_params(params, transform)
    degree = {0: 0, 3: 1, 8: 2, 15: 3}[bands]
    dirs = torch.randn((5, 3), generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    before = colors_from_sh(torch.cat([params["sh0"], params["shN"]], 1), dirs, degree)
    after = colors_from_sh(torch.cat([moved["sh0"], moved["shN"]], 1), dirs @ transform[:3, :3].T, degree)
    torch.testing.assert_close(after, before, rtol=1e-9, atol=1e-9)


def test_moving_there_and_back_returns_the_splat() -> None:
    params, transform = splat(3), similarity(4, 0.5)
    back = move_params(move_params(params, transform), torch.linalg.inv(transform))
    for name in ("means", "scales", "shN"):
        torch.testing.assert_close(back[name], params[name], rtol=1e-9, atol=1e-9)
    cosines = torch.nn.functional.cosine_similarity(back["quats"], params["quats"], dim=1).abs()
    torch.testing.assert_close(cosines, torch.ones(5, dtype=torch.float64))


def test_what_is_not_a_similarity_is_refused() -> None:
    mirrored = torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0]))
    with pytest.raises(ValueError, match="transform is not a similarity"):
        move_params(splat(0), mirrored)
    with pytest.raises(ValueError, match="transform is not a similarity"):
        move_params(splat(0), torch.diag(torch.tensor([1.0, 2.0, 1.0, 1.0])))
