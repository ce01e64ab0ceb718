"""Fast density control against the oracle: every reading, exactly, and whole events."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast import density as fast
from pop_ref import density as oracle

CONFIGS = st.builds(
    oracle.DensityConfig,
    inclusive=st.booleans(),
    grad_denominator=st.sampled_from(["visible_views", "window"]),
    grow_on_gradient=st.booleans(),
    grow_on_gradient_in_blur_window=st.booleans(),
    prune_too_big=st.booleans(),
    # dyadic thresholds, which the values below hit exactly
    grow_grad2d=st.sampled_from([0.5, 1.0]),
    grow_scale3d=st.just(0.25),
    prune_scale3d=st.just(0.5),
    prune_opa=st.just(0.125),
    theta_blur=st.sampled_from([0.25, 0.5]),
    blur_min_pixels=st.sampled_from([0.0, 5.0]),
    blur_window=st.sampled_from(["any_view", "sum", "own_view"]),
    blur_rule=st.sampled_from(["by_scale", "split"]),
    revised_opacity=st.booleans(),
)
STEPS = st.sampled_from([600, 3000, 5000, 7000, 7100])
KEYS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}


def population(n: int, seed: int) -> oracle.Rows:
    rng = np.random.default_rng(seed)
    params = {name: rng.normal(size=(n, *shape)) for name, shape in KEYS.items()}
    params["scales"] = np.log(rng.choice([0.125, 0.25, 0.5, 0.75], (n, 3)))
    params["opacities"] = rng.choice([-9.0, 0.0, 3.0], n)
    m, v = ({name: rng.random(array.shape) for name, array in params.items()} for _ in range(2))
    return oracle.Rows(params, m, v)


def in_torch(rows: oracle.Rows, dtype: torch.dtype) -> fast.Rows:
    return fast.Rows(*({k: torch.tensor(a, dtype=dtype) for k, a in part.items()} for part in parts(rows)))


def parts(rows: oracle.Rows | fast.Rows) -> tuple:
    return rows.params, rows.m, rows.v


def windows(
    n: int, seed: int, config: oracle.DensityConfig, dtype: torch.dtype
) -> tuple[oracle.Statistics, fast.Statistics]:
    """Accumulate three views of different sizes, whose gradients are dyadic, in both."""
    rng = np.random.default_rng(seed)
    ours, theirs = fast.zero_statistics(n, dtype), oracle.zero_statistics(n)
    for width, height in ((4, 4), (8, 4), (4, 2)):
        v_means2d = rng.choice([0.0, 0.125, 0.25], (n, 1)) * np.array([0.5, 0.0] if width == 8 else [0.0, 1.0])
        visible, counts = rng.random(n) < 0.75, rng.integers(0, 10, n)
        kept = int(rng.integers(1, width * height)) if width == 8 else None
        theirs = oracle.accumulate(theirs, v_means2d, visible, counts, width, height, config, kept)
        view = (torch.tensor(v_means2d, dtype=dtype), torch.tensor(visible), torch.tensor(counts))
        ours = fast.accumulate(ours, *view, width, height, config, kept)
    return theirs, ours


def draws(n: int) -> np.ndarray:
    return np.cos(np.arange(6.0 * n)).reshape(2, n, 3)


dtypes = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


@dtypes
@given(n=st.integers(0, 8), seed=st.integers(0, 999), config=CONFIGS, step=STEPS)
def test_statistics_and_masks_are_the_oracles_exactly_also_at_thresholds(
    n: int, seed: int, config: oracle.DensityConfig, step: int, dtype: torch.dtype
) -> None:
    theirs, ours = windows(n, seed, config, dtype)
    for field in fields(theirs):
        np.testing.assert_array_equal(np.asarray(getattr(ours, field.name)), getattr(theirs, field.name))
    np.testing.assert_allclose(fast.average_grads(ours, config), oracle.average_grads(theirs, config), rtol=1e-6)
    rng = np.random.default_rng(seed)
    scales, opacities = rng.choice([0.125, 0.25, 0.5, 0.75], (n, 3)), rng.choice([0.0625, 0.125, 0.5], n)
    expected = oracle.grow_masks(theirs, scales, 1.0, step, config)
    got = fast.grow_masks(ours, torch.tensor(scales, dtype=dtype), 1.0, step, config)
    for mask, want in zip(got, expected, strict=True):
        np.testing.assert_array_equal(mask.numpy(), want)
    tensors = (torch.tensor(opacities, dtype=dtype), torch.tensor(scales, dtype=dtype))
    want = oracle.prune_mask(opacities, scales, 1.0, step, config)
    np.testing.assert_array_equal(fast.prune_mask(*tensors, 1.0, step, config).numpy(), want)


@given(n=st.integers(0, 8), seed=st.integers(0, 999), config=CONFIGS, step=STEPS)
def test_an_event_is_the_oracles(n: int, seed: int, config: oracle.DensityConfig, step: int) -> None:
    # a threshold that exp and log of 1/4, 1/2 or 3/4 cannot straddle
    config = replace(config, grow_scale3d=0.3, prune_scale3d=0.6)
    theirs, ours = windows(n, seed, config, torch.float64)
    rows = population(n, seed)
    expected, emptied = oracle.densify_and_prune(rows, theirs, 1.0, step, draws, config)
    got, cleared = fast.densify_and_prune(
        in_torch(rows, torch.float64), ours, 1.0, step, lambda n: torch.tensor(draws(n)), config
    )
    for part, want in zip(parts(got), parts(expected), strict=True):
        for name in KEYS:
            np.testing.assert_allclose(part[name].numpy(), want[name], rtol=1e-12, atol=1e-14)
    assert cleared.n_views == emptied.n_views == 0
    assert len(cleared.grad_sum) == len(got) == len(expected)
    assert not torch.any(cleared.blurred)


@dtypes
def test_survivors_keep_their_bits_and_their_type(dtype: torch.dtype) -> None:
    rows = in_torch(population(6, 1), dtype)
    mask = torch.tensor([True, False, True, False, False, True])
    normals = torch.tensor(draws(3), dtype=dtype)
    cloned, split, pruned = (
        fast.clone_rows(rows, mask),
        fast.split_rows(rows, mask, normals),
        fast.prune_rows(rows, mask),
    )
    for k, before in enumerate(parts(rows)):
        for name, tensor in before.items():
            assert torch.equal(parts(cloned)[k][name][:6], tensor)
            assert torch.equal(parts(split)[k][name][:3], tensor[~mask])
            assert torch.equal(parts(pruned)[k][name], tensor[~mask])
            assert parts(split)[k][name].dtype == dtype


@given(st.floats(-30.0, 30.0))
def test_revised_opacity_is_the_oracles(logit: float) -> None:
    rows = population(1, 0)
    rows = replace(rows, params={**rows.params, "opacities": np.array([logit])})
    mask = np.array([True])
    expected = oracle.split_rows(rows, mask, draws(1), revised_opacity=True).params["opacities"]
    got = fast.split_rows(
        in_torch(rows, torch.float64), torch.tensor(mask), torch.tensor(draws(1)), revised_opacity=True
    )
    np.testing.assert_allclose(got.params["opacities"].numpy(), expected, rtol=1e-13)


def test_reset_is_the_oracles() -> None:
    rows = population(5, 3)
    expected, got = oracle.reset_opacities(rows, 0.25), fast.reset_opacities(in_torch(rows, torch.float64), 0.25)
    for part, want in zip(parts(got), parts(expected), strict=True):
        for name in KEYS:
            np.testing.assert_allclose(part[name].numpy(), want[name], rtol=1e-15)


def test_draws_for_another_number_of_parents_are_refused() -> None:
    rows = in_torch(population(3, 0), torch.float32)
    with pytest.raises(ValueError, match=r"normals is \[2, 3, 3\]; it must be \[2, 1, 3\]"):
        fast.split_rows(rows, torch.tensor([True, False, False]), torch.zeros(2, 3, 3))


def test_blur_set_takes_several_views_at_once() -> None:
    counts = torch.tensor([[1, 2], [3, 0]])
    assert fast.blur_set(counts, 8, 4, 1 / 32).tolist() == [[False, True], [True, False]]
