"""What a densification step does: rows, moments and statistics stay together, and the oracle agrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.density import DensificationStep, GsplatStrategy, POPStrategy
from pop_ref import density as oracle
from pop_ref.density_rows import Rows as OracleRows
from tests.app.populations import HEIGHT, KEYS, WIDTH, densified_at, make, make_info, moments, packed


def test_small_gaussians_are_cloned_with_their_bits_and_large_ones_split_in_two():
    params, optimizers = make(4)
    params["scales"].data[2] = math.log(0.5)
    before = {key: value.detach().clone() for key, value in params.items()}
    first, second, steps = (x.clone() for x in moments(optimizers, params, "means"))
    grads = torch.tensor([[0.0, 0], [1.0, 0], [1.0, 0], [0.0, 0]])
    change = densified_at(POPStrategy(), params, optimizers, make_info(4, grads), step=600)
    assert change == DensificationStep(cloned=1, split=1, pruned=0)
    assert change.record() == {"cloned": 1, "split": 1, "pruned": 0}
    # survivors 0, 1, 3; the clone of 1; two children of 2
    assert len(params["means"]) == 6
    for key in KEYS:
        assert torch.equal(params[key][:4], before[key][[0, 1, 3, 1]])
    assert torch.equal(params["quats"][4:], before["quats"][[2, 2]])
    assert torch.allclose(params["scales"][4:], before["scales"][[2, 2]] - math.log(1.6))
    assert not torch.equal(params["means"][4], params["means"][5])
    got = moments(optimizers, params, "means")
    assert torch.equal(got[0], torch.cat([first[[0, 1, 3]], torch.zeros(3, 3)]))
    assert torch.equal(got[1], torch.cat([second[[0, 1, 3]], torch.zeros(3, 3)]))
    assert torch.equal(got[2], steps)
    for key in KEYS:
        assert optimizers[key].param_groups[0]["params"][0] is params[key]
        assert list(optimizers[key].state) == [params[key]]


def test_a_parameter_dict_with_a_frozen_extra_is_edited_too():
    params, optimizers = make(4)
    extra = torch.nn.Parameter(torch.arange(4.0), requires_grad=False)
    params = torch.nn.ParameterDict({**params, "tags": extra})
    strategy = POPStrategy()
    strategy.check_sanity(params, optimizers)
    params["opacities"].data[1] = -6.0
    grads = torch.tensor([[1.0, 0], [0.0, 0], [0.0, 0], [1.0, 0]])
    densified_at(strategy, params, optimizers, make_info(4, grads), step=600)
    assert params["tags"].tolist() == [0.0, 2.0, 3.0, 0.0, 3.0]
    assert not params["tags"].requires_grad


def test_optimizers_step_on_after_an_event():
    params, optimizers = make(4)
    grads = torch.ones(4, 2)
    densified_at(POPStrategy(), params, optimizers, make_info(4, grads), step=600)
    before = params["means"].detach().clone()
    params["means"].grad = torch.ones_like(params["means"])
    optimizers["means"].step()
    assert (params["means"] != before).all()


def test_transparent_gaussians_are_pruned_and_oversized_ones_only_after_step_3000():
    for step, survivors in ((2900, 2), (3000, 2), (3100, 1)):
        params, optimizers = make(3)
        params["opacities"].data[0] = -6.0
        params["scales"].data[1] = math.log(0.2)
        densified_at(POPStrategy(blur_stop_iter=-1, prune_too_big=True), params, optimizers, make_info(3), step)
        assert len(params["means"]) == survivors, step
    params, optimizers = make(3)
    params["scales"].data[1] = math.log(0.2)
    densified_at(POPStrategy(), params, optimizers, make_info(3), 3100)
    assert len(params["means"]) == 3


@pytest.mark.parametrize("prune_opa", [0.005, 0.002])
@pytest.mark.parametrize("ceiling", [0.01, 0.25])
def test_a_reset_lowers_opacities_to_its_ceiling_and_forgets_their_moments_only(ceiling: float, prune_opa: float):
    params, optimizers = make(3)
    other = [x.clone() for x in moments(optimizers, params, "scales")]
    densified_at(GsplatStrategy(reset_opa=ceiling, prune_opa=prune_opa), params, optimizers, make_info(3), 3000)
    assert torch.allclose(torch.sigmoid(params["opacities"]), torch.tensor(ceiling))
    # the ceiling is the oracle's, and like there no multiple of the pruning threshold
    config = oracle.DensityConfig(reset_every=3000, prune_opa=prune_opa)
    assert GsplatStrategy(prune_opa=prune_opa).reset_opa == config.reset_opa == 0.01
    first, second, steps = moments(optimizers, params, "opacities")
    assert not first.any()
    assert not second.any()
    assert steps == 1
    assert all(torch.equal(a, b) for a, b in zip(other, moments(optimizers, params, "scales"), strict=True))


def test_a_reset_does_not_raise_opacities():
    params, optimizers = make(2, opacities=0.006)
    before = params["opacities"].detach().clone()
    densified_at(GsplatStrategy(), params, optimizers, make_info(2), 3000)
    assert torch.equal(params["opacities"], before)


def test_the_gradient_is_measured_in_half_images_and_averaged_over_visible_views():
    params, optimizers = make(2)
    strategy, threshold = POPStrategy(refine_every=3, refine_start_iter=0), 0.0002
    # pixel gradients that make a Gaussian exceed the threshold in one view of the one it is seen in, of three
    just_over = threshold / (WIDTH / 2) * 1.01
    state = strategy.initialize_state()
    for step, visible in ((1, [True, False]), (2, [True, False]), (3, [True, True])):
        grads = torch.tensor([[just_over, 0.0], [just_over, 0.0]]) * torch.tensor(visible)[:, None]
        if step < 3:
            grads[0] = 0.0
        info = make_info(2, grads, visible)
        change = strategy.step_post_backward(params, optimizers, state, step, info)
        assert (change is None) == (step < 3)
    # 0 was seen three times and moved once; 1 was seen once and moved
    assert change is not None
    assert change.cloned == 1
    assert torch.equal(params["means"][2], params["means"][1])
    assert not state["grad2d"].any()
    assert not state["count"].any()


def test_inclusive_selects_a_gradient_at_the_threshold():
    for inclusive, n in ((False, 1), (True, 2)):
        params, optimizers = make(1)
        grads = torch.tensor([[2.0**-10, 0.0]])
        strategy = GsplatStrategy(inclusive=inclusive, grow_grad2d=2.0**-10 * WIDTH / 2)
        densified_at(strategy, params, optimizers, make_info(1, grads), 600)
        assert len(params["means"]) == n


def test_absgrad_reads_the_absolute_gradient():
    params, optimizers = make(1)
    info = make_info(1)
    info["means2d"].absgrad = torch.ones(1, 1, 2)
    densified_at(POPStrategy(absgrad=True), params, optimizers, info, 600)
    assert len(params["means"]) == 2


@pytest.mark.parametrize("strategy", [POPStrategy(pop_views="window"), GsplatStrategy(refine_scale2d_stop_iter=15_000)])
def test_packed_and_unpacked_infos_give_the_same_bits(strategy):
    g = torch.Generator().manual_seed(1)
    results = []
    for is_packed in (False, True):
        params, optimizers = make(20)
        g.manual_seed(1)
        state = strategy.initialize_state(1.0, seed=5)
        for step in (3098, 3099, 3100):
            visible = torch.rand(2, 20, generator=g) < 0.7
            grads = 1e-5 * torch.randn(2, 20, 2, generator=g) * visible[..., None]
            counts = torch.randint(0, 2, (2, 20), generator=g) * visible
            info = make_info(20, grads, visible, counts, cameras=2)
            info["radii"] = torch.randint(1, 9, (2, 20, 2), generator=g).int() * visible[..., None].int()
            change = strategy.step_post_backward(
                params, optimizers, state, step, packed(info) if is_packed else info, packed=is_packed
            )
        results.append((params, change))
    assert results[0][1] == results[1][1]
    assert results[0][1].cloned > 0
    for key in KEYS:
        assert torch.equal(results[0][0][key], results[1][0][key])


def test_extents_on_screen_split_and_prune_where_they_are_asked_for():
    params, optimizers = make(3)
    info = make_info(3)
    info["radii"] = torch.tensor([[[1, 1], [4, 1], [1, 20]]]).int()
    densified_at(GsplatStrategy(refine_scale2d_stop_iter=15_000), params, optimizers, info, 3100)
    # 0 stays, 1 (4/64 > 0.05) is split, 2 (20/64) is split, and its children inherit an extent that is pruned
    assert len(params["means"]) == 3


def test_the_same_seed_splits_to_the_same_bits_and_another_does_not():
    means = []
    for seed in (1, 1, 2):
        params, optimizers = make(3, scale=0.05)
        strategy = POPStrategy()
        state = strategy.initialize_state(seed=seed)
        strategy.step_post_backward(params, optimizers, state, 600, make_info(3, torch.ones(3, 2)))
        means.append(params["means"].detach())
    assert torch.equal(means[0], means[1])
    assert not torch.equal(means[0], means[2])


@given(
    rows=st.lists(
        st.tuples(
            st.sampled_from([0.0, 1e-6, 1e-2]),  # pixel gradient
            st.integers(0, 4),  # pixels dominated
            st.booleans(),  # visible
            st.sampled_from([0.004, 0.05, 0.3]),  # size
            st.sampled_from([0.001, 0.5, 1.0 - 2**-10]),  # opacity
        ),
        min_size=1,
        max_size=8,
    ),
    step=st.sampled_from([600, 3000, 3100, 7000, 7100]),
    blur_rule=st.sampled_from(["by_scale", "split"]),
    inclusive=st.booleans(),
)
def test_an_event_equals_the_oracles_row_for_row(rows, step, blur_rule, inclusive):
    n = len(rows)
    gradient, dominant, visible, size, opacity = (np.array(column) for column in zip(*rows, strict=True))
    params, optimizers = make(n)
    params["scales"].data = torch.from_numpy(np.log(size)).float()[:, None].repeat(1, 3)
    params["opacities"].data = torch.from_numpy(np.log(opacity / (1 - opacity))).float()
    grads = np.stack([gradient * visible, np.zeros(n)], axis=1)
    settings = {"blur_rule": blur_rule, "inclusive": inclusive, "theta_blur": 2 / (WIDTH * HEIGHT)}
    strategy = POPStrategy(**settings)
    drawn = []

    def normals(k: int) -> np.ndarray:
        generator = torch.Generator().manual_seed(3)
        drawn.append(torch.randn((2, k, 3), generator=generator).double().numpy() if k else np.zeros((2, 0, 3)))
        return drawn[-1]

    double = {key: value.detach().double().numpy() for key, value in params.items()}
    m, v = ({k: moments(optimizers, params, k)[i].double().numpy() for k in KEYS} for i in (0, 1))
    config = oracle.DensityConfig(**settings)
    statistics = oracle.accumulate(
        oracle.zero_statistics(n), grads, visible.astype(bool), dominant.astype(np.int64), WIDTH, HEIGHT, config
    )
    want, _ = oracle.densify_and_prune(OracleRows(double, m, v), statistics, 1.0, step, normals, config)

    densified_at(strategy, params, optimizers, make_info(n, grads, visible, torch.from_numpy(dominant)), step)
    assert len(params["means"]) == len(want)
    for key in KEYS:
        np.testing.assert_allclose(params[key].detach().numpy(), want.params[key], rtol=2e-6, atol=2e-6)
        np.testing.assert_array_equal(moments(optimizers, params, key)[0].numpy(), want.m[key].astype(np.float32))
        np.testing.assert_array_equal(moments(optimizers, params, key)[1].numpy(), want.v[key].astype(np.float32))
