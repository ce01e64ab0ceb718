"""What the laws of density control leave open: types, several views at once, thresholds hit exactly, refusals."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.density import rows as ops
from pop_fast.stages import density as fast
from pop_fast.train.model import make_optimizers
from pop_ref import density as oracle
from pop_ref.conformance.backends import shipped

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
)
STEPS = st.sampled_from([600, 3000, 5000, 7000, 7100])
KEYS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}


@pytest.mark.parametrize("backend", ["fast64", "fast32"])
@given(
    n=st.integers(0, 8), seed=st.integers(0, 999), config=CONFIGS, step=STEPS, scene_scale=st.sampled_from([1.0, 4.0])
)
def test_statistics_and_masks_are_the_oracles_exactly_also_at_thresholds(
    n: int, seed: int, config: oracle.DensityConfig, step: int, scene_scale: float, backend: str
) -> None:
    judged = shipped(backend).stage
    rng = np.random.default_rng(seed)
    ours = theirs = oracle.zero_statistics(n)
    for width, height in ((4, 4), (8, 4), (4, 2)):
        v_means2d = rng.choice([0.0, 0.125, 0.25], (n, 1)) * np.array([0.5, 0.0] if width == 8 else [0.0, 1.0])
        kept = int(rng.integers(1, width * height)) if width == 8 else None
        view = (v_means2d, rng.random(n) < 0.75, rng.integers(0, 10, n), width, height, config, kept)
        theirs = oracle.accumulate(theirs, *view)
        found = judged("accumulate")(ours, *view)
        ours = oracle.Statistics(**{f.name: getattr(found, f.name) for f in fields(theirs)})
    for name in ("grad_sum", "n_visible", "n_views", "blurred"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    scales = scene_scale * rng.choice([0.125, 0.25, 0.5, 0.75], (n, 3))
    opacities = rng.choice([0.0625, 0.125, 0.5], n)
    for name, given_rows in (("grow_masks", (theirs, scales)), ("prune_mask", (opacities, scales))):
        rest = (scene_scale, step, config)
        np.testing.assert_array_equal(judged(name)(*given_rows, *rest), getattr(oracle, name)(*given_rows, *rest))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_edit_keeps_the_type_the_counter_and_the_rate(dtype: torch.dtype) -> None:
    mask = torch.tensor([True, False, True, False, False, True])
    normals = torch.ones((2, 3, 3), dtype=dtype)
    for edit, args in ((ops.clone, (mask,)), (ops.split, (mask, normals)), (ops.prune, (mask,))):
        params = {key: torch.nn.Parameter(torch.ones((6, *shape), dtype=dtype)) for key, shape in KEYS.items()}
        optimizers = make_optimizers(params)
        for key, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = 0.25
            params[key].grad = torch.ones_like(params[key])
            optimizer.step()
        edit(params, optimizers, {}, *args)
        for key, optimizer in optimizers.items():
            assert params[key].dtype == dtype
            state = optimizer.state[params[key]]
            assert state["step"] == 1.0
            assert state["exp_avg"].shape == state["exp_avg_sq"].shape == params[key].shape
            assert state["exp_avg"].dtype == dtype
            assert optimizer.param_groups[0]["lr"] == 0.25


def test_draws_for_another_number_of_parents_are_refused() -> None:
    params = {key: torch.nn.Parameter(torch.ones((3, *shape))) for key, shape in KEYS.items()}
    with pytest.raises(ValueError, match=r"normals is \[2, 3, 3\]; it must be \[2, 1, 3\]"):
        ops.split(params, {}, {}, torch.tensor([True, False, False]), torch.zeros(2, 3, 3))


@given(st.floats(-30.0, 30.0))
def test_revised_opacity_is_the_oracles_also_next_to_zero_and_one(logit: float) -> None:
    rows = oracle.rows_from_params(
        {key: np.full((1, *shape), logit if key == "opacities" else 1.0) for key, shape in KEYS.items()}
    )
    split = (rows, np.array([True]), np.ones((2, 1, 3)), True)
    got = shipped("fast64").stage("split_rows")(*split).params["opacities"]
    np.testing.assert_allclose(got, oracle.split_rows(*split).params["opacities"], rtol=1e-13)


def test_blur_set_takes_several_views_at_once() -> None:
    counts = torch.tensor([[1, 2], [3, 0]])
    assert fast.blur_set(counts, 8, 4, 1 / 32).tolist() == [[False, True], [True, False]]
