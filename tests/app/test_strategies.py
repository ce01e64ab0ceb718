"""The strategies: their schedules, their protocol, what they ask for and refuse.

The paper's other methods as runs: when what happens, what density control does, on every CPU engine."""

from __future__ import annotations

import math
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from pop_fast.api.rasterize import rasterization
from pop_fast.api.registry import get_backend
from pop_fast.density import DensificationStep, DensityControl, GsplatStrategy, InriaStrategy, POPStrategy, Strategy
from pop_fast.density.control import SHORTEST_REFINE_EVERY
from pop_fast.density.protocol import Draws
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_ref import density as oracle
from pop_ref import fisher, mini_splatting, selection, taming
from pop_ref.chord import dominant_points
from pop_ref.contributions import contributions
from pop_ref.density import average_grads
from pop_ref.density_rows import Rows as OracleRows
from pop_ref.recipes import RECIPES
from pop_ref.records import Camera
from pop_ref.render import render
from pop_ref.sensitivity import sensitivities
from pop_ref.settings import PopTerm
from pop_ref.training import gaussians_from_params
from tests.app.populations import HEIGHT, WIDTH, densified_at, make, make_info, moments, packed
from tests.app.tiny import tiny_capture, tiny_config
from tests.train.oracle_steps import state_of


def test_a_reset_at_step_0_is_a_switch():
    assert GsplatStrategy(reset_at_zero=True).is_reset_step(0)
    assert not GsplatStrategy().is_reset_step(0)


def test_both_strategies_satisfy_the_protocol():
    assert isinstance(POPStrategy(), Strategy)
    assert isinstance(GsplatStrategy(), Strategy)


def test_gsplat_attribute_names_exist_with_gsplat_numbers():
    for strategy in (POPStrategy(), GsplatStrategy()):
        got = [getattr(strategy, name) for name in ("prune_opa", "grow_grad2d", "grow_scale3d", "prune_scale3d")]
        assert got == [0.005, 0.0002, 0.01, 0.1]
        assert (strategy.refine_start_iter, strategy.refine_stop_iter, strategy.refine_every) == (500, 15_000, 100)
        assert (strategy.absgrad, strategy.revised_opacity, strategy.key_for_gradient) == (False, False, "means2d")
    assert (GsplatStrategy().reset_every, POPStrategy().reset_every) == (3000, 0)


def test_a_scaled_schedule_keeps_its_shape_and_a_window_worth_averaging():
    quick = POPStrategy().scaled(0.1)
    assert (quick.refine_start_iter, quick.refine_stop_iter, quick.refine_every) == (50, 1500, SHORTEST_REFINE_EVERY)
    assert (quick.blur_start_iter, quick.blur_stop_iter, quick.pop_stop_iter) == (300, 700, 1500)
    assert quick.lambda_pop == POPStrategy().lambda_pop
    assert POPStrategy().scaled(1.0) == POPStrategy()
    assert POPStrategy(refine_every=10).scaled(0.1).refine_every == 10


def test_resets_keep_the_steps_that_are_needed_to_recover_from_them():
    control = GsplatStrategy(pause_refine_after_reset=200)
    for factor in (0.01, 0.1, 1.0):
        scaled = control.scaled(factor)
        assert (scaled.reset_every, scaled.pause_refine_after_reset) == (3000, 200)
        assert scaled.prune_too_big_after == 3000
        assert scaled.blur_stop_iter == -1
    assert (control.scaled(2.0).reset_every, control.scaled(2.0).pause_refine_after_reset) == (6000, 400)
    assert not any(GsplatStrategy().scaled(0.1).is_reset_step(step) for step in range(3000))


def test_strategies_are_values_that_take_their_numbers_from_the_recipes():
    for name, kind in (("POP", POPStrategy), ("gsplat", GsplatStrategy), ("3DGS", InriaStrategy)):
        recipe, strategy = RECIPES[name], kind()
        for field in fields(recipe.density):
            assert getattr(strategy, field.name) == getattr(recipe.density, field.name), (name, field.name)
        for field in fields(PopTerm):
            assert getattr(strategy, field.name) == getattr(recipe, field.name), (name, field.name)
        with pytest.raises(FrozenInstanceError):
            strategy.prune_opa = 0.5


def test_dominant_counts_are_asked_for_where_they_are_read():
    assert [s for s in range(0, 30_000, 500) if POPStrategy().needs_dominance(s)] == list(range(0, 15_000, 500))
    assert not any(GsplatStrategy().needs_dominance(s) for s in range(0, 30_000, 500))
    params, optimizers = make(2)
    for strategy in (POPStrategy(lambda_pop=0.0), POPStrategy(lambda_pop=0.0, blur_window="sum"), POPStrategy()):
        for step in (0, 7000, 7001, 14_999, 15_000):
            info = make_info(2)
            if not strategy.needs_dominance(step):
                del info["dominant_counts"]
            state = strategy.initialize_state()
            strategy.regularizer(torch.sigmoid(params["opacities"]), state, step, info)
            strategy.step_post_backward(params, optimizers, state, step, info)


def test_missing_dominant_counts_are_explained():
    info = make_info(2)
    del info["dominant_counts"]
    strategy = POPStrategy()
    with pytest.raises(ValueError, match=r"dominant_counts.*pop_fast\.rasterization"):
        strategy.regularizer(torch.tensor([0.5, 0.5]), strategy.initialize_state(), 0, info)
    params, optimizers = make(2)
    densified_at(GsplatStrategy(), params, optimizers, info, 600)


def test_sanity_checks_name_the_key():
    params, optimizers = make(2)
    strategy = POPStrategy()
    strategy.check_sanity(params, optimizers)
    with pytest.raises(ValueError, match="'quats'"):
        strategy.check_sanity({k: v for k, v in params.items() if k != "quats"}, optimizers)
    with pytest.raises(ValueError, match="'sh0' is a parameter without an optimizer"):
        strategy.check_sanity(params, {k: v for k, v in optimizers.items() if k != "sh0"})
    with pytest.raises(ValueError, match="'scales' has 3 rows but 'means' has 2"):
        strategy.check_sanity({**params, "scales": torch.nn.Parameter(torch.zeros(3, 3))}, optimizers)
    with pytest.raises(ValueError, match="exactly one tensor"):
        strategy.check_sanity(params, {**optimizers, "sh0": torch.optim.Adam(list(params.values()))})
    with pytest.raises(ValueError, match="refine_every"):
        POPStrategy(refine_every=0).check_sanity(params, optimizers)


# What a densification step does: rows, moments and statistics stay together, and the oracle agrees.


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


# What is POP's own: the blur rule and the prior.


def test_a_gaussian_that_dominates_enough_pixels_of_one_view_grows_in_the_blur_window_only():
    threshold = 2e-5
    height = width = 1000
    for step, counts, n in ((3000, [20, 21], 3), (7000, [20, 21], 3), (2900, [21, 21], 2), (7100, [21, 21], 2)):
        params, optimizers = make(2)
        info = make_info(2, counts=torch.tensor(counts), width=width, height=height)
        densified_at(POPStrategy(theta_blur=threshold), params, optimizers, info, step)
        assert len(params["means"]) == n, step


def test_a_threshold_in_pixels_bounds_the_blur_rule_from_below():
    for least, counts, n in ((0.0, [0, 1], 3), (11.0, [11, 12], 3), (11.0, [1, 11], 2)):
        params, optimizers = make(2)
        info = make_info(2, counts=torch.tensor(counts), width=240, height=135)
        densified_at(POPStrategy(blur_min_pixels=least), params, optimizers, info, 3000)
        assert len(params["means"]) == n


@pytest.mark.parametrize(("window", "n"), [("any_view", 2), ("sum", 3), ("own_view", 1)])
def test_what_the_dominant_count_is_taken_over_is_a_switch(window, n):
    # Gaussian 0 is over the threshold of 2 px in the first view, Gaussian 1 in the sum alone
    params, optimizers = make(2)
    params["opacities"].data[:] = 0.0
    strategy = POPStrategy(theta_blur=2 / (WIDTH * HEIGHT), blur_window=window, refine_every=2)
    state = strategy.initialize_state()
    for step, counts in ((3001, [3, 2]), (3002, [0, 1])):
        strategy.step_post_backward(params, optimizers, state, step, make_info(2, counts=torch.tensor(counts)))
    assert len(params["means"]) == {"any_view": 3, "sum": 4, "own_view": 2}[window]
    assert n == len(params["means"]) - 1


@pytest.mark.parametrize("window", ["any_view", "sum", "own_view"])
def test_the_share_of_a_masked_view_is_of_the_pixels_that_it_keeps(window):
    kept = WIDTH * HEIGHT // 4
    for pixels, n in ((kept // 2, 3), (kept // 2 + 1, 4)):
        params, optimizers = make(3)
        info = {**make_info(3, counts=[pixels, 0, 0]), "kept_pixels": kept}
        densified_at(POPStrategy(theta_blur=0.5, blur_window=window), params, optimizers, info, 3000)
        assert len(params["means"]) == n


def test_blur_flags_are_forgotten_after_a_densification_step():
    params, optimizers = make(1)
    strategy = POPStrategy()
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 3000, make_info(1, counts=torch.tensor([99])))
    assert len(params["means"]) == 2
    strategy.step_post_backward(params, optimizers, state, 3100, make_info(2))
    assert len(params["means"]) == 2


def test_blur_clones_small_and_splits_large_or_splits_all():
    for rule, change in (("by_scale", DensificationStep(1, 1)), ("split", DensificationStep(0, 2))):
        params, optimizers = make(2)
        params["scales"].data[1] = math.log(0.05)
        info = make_info(2, counts=torch.tensor([99, 99]))
        assert densified_at(POPStrategy(blur_rule=rule), params, optimizers, info, 3000) == change


def test_growth_by_gradient_can_be_switched_off_altogether_or_in_the_blur_window():
    grads = torch.ones(1, 2)
    for strategy, step, n in (
        (POPStrategy(grow_on_gradient=False), 600, 1),
        (POPStrategy(grow_on_gradient_in_blur_window=False), 600, 2),
        (POPStrategy(grow_on_gradient_in_blur_window=False), 3000, 1),
    ):
        params, optimizers = make(1)
        densified_at(strategy, params, optimizers, make_info(1, grads), step)
        assert len(params["means"]) == n


def test_nothing_happens_from_step_15000():
    params, optimizers = make(2)
    assert densified_at(POPStrategy(), params, optimizers, make_info(2, torch.ones(2, 2)), 15_000) is None
    assert len(params["means"]) == 2


def test_the_regularizer_pulls_dominant_opacities_up_and_the_others_down():
    strategy = POPStrategy()
    opacities = torch.tensor([0.25, 0.5, 0.75, 0.5], requires_grad=True)
    info = make_info(4, counts=torch.tensor([5, 0, 1, 0]))
    term = strategy.regularizer(opacities, strategy.initialize_state(), 0, info)
    assert term is not None
    assert term.item() == pytest.approx(1e-3 * (0.5 + 0.5))
    term.backward()
    assert torch.allclose(opacities.grad, 1e-3 * torch.tensor([-0.5, 0.5, -0.5, 0.5]))


def test_the_regularizer_is_off_outside_its_steps_and_at_weight_0():
    info, opacities = make_info(2), torch.tensor([0.5, 0.5])
    for strategy, step in (
        (POPStrategy(), 15_000),
        (POPStrategy(pop_start_iter=500), 499),
        (POPStrategy(lambda_pop=0), 0),
    ):
        assert strategy.regularizer(opacities, strategy.initialize_state(), step, info) is None
    assert GsplatStrategy().regularizer(opacities, {}, 0, info) is None


def test_importance_can_be_kept_for_the_window_and_the_loss_for_the_visible():
    opacities = torch.tensor([0.25, 0.5, 0.75], requires_grad=True)
    strategy = POPStrategy(pop_views="window", pop_over="visible")
    params, optimizers = make(3)
    state = strategy.initialize_state()
    strategy.step_post_backward(params, optimizers, state, 1, make_info(3, counts=torch.tensor([1, 0, 0])))
    info = make_info(3, visible=[True, True, False], counts=torch.tensor([0, 0, 0]))
    for each in (info, packed(info)):
        term = strategy.regularizer(opacities, state, 2, each)
        assert term is not None
        assert term.item() == pytest.approx(1e-3 * (0.75 + 0.5))


def test_a_trainer_that_leaves_out_the_prior_is_warned() -> None:
    params, optimizers = make(2)
    strategy = POPStrategy()
    state = strategy.initialize_state()
    with pytest.warns(UserWarning, match=r"add strategy\.regularizer"):
        strategy.step_post_backward(params, optimizers, state, 1, make_info(2))
    info = make_info(2)
    strategy.regularizer(torch.sigmoid(params["opacities"]), state, 2, info)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        strategy.step_post_backward(params, optimizers, state, 2, info)
        # nothing is missed where there is no prior
        strategy.step_post_backward(params, optimizers, state, strategy.pop_stop_iter, make_info(2))
        GsplatStrategy().step_post_backward(params, optimizers, GsplatStrategy().initialize_state(), 1, make_info(2))


def documented_loop(steps: int, strategy: POPStrategy, learning_rate: float = 0.01) -> dict[str, torch.Tensor]:
    """Run the loop that the docstring shows another trainer, with `rasterization`; return the parameters."""
    block = (POPStrategy.__doc__ or "").split("where there is one:")[1].split("The defaults are")[0]
    params, _ = make(12, scale=0.3)
    params["means"].data[:, 2] += 4.0
    optimizers = {key: torch.optim.SGD([value], lr=learning_rate) for key, value in params.items()}
    K = torch.tensor([[20.0, 0.0, 12.0], [0.0, 20.0, 8.0], [0.0, 0.0, 1.0]])
    views = [(torch.eye(4), K, torch.full((16, 24, 3), 0.5))] * steps
    names: dict[str, object] = {
        "params": params,
        "optimizers": optimizers,
        "strategy": strategy,
        "views": views,
        "width": 24,
    }
    exec(
        textwrap.dedent(block),
        {**names, "height": 16, "scene_scale": 1.0, "torch": torch, "rasterization": rasterization},
    )
    return {key: value.detach() for key, value in params.items()}


def test_the_loop_that_the_docstring_shows_trains_with_the_prior_and_is_not_warned() -> None:
    # the last steps have no prior
    strategy = POPStrategy(pop_stop_iter=4, refine_start_iter=2, refine_every=3, lambda_pop=0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(documented_loop(6, strategy)["means"]) > 0
        without, with_prior = (documented_loop(1, POPStrategy(lambda_pop=weight)) for weight in (0.0, 0.5))
    moved = (with_prior["opacities"] - without["opacities"]) / 0.01
    # o = 0.5, whose slope is 1/4: up where a pixel is won, down elsewhere, each by its share
    up, down = moved > 0.0, moved < 0.0
    assert up.any()
    assert down.any()
    torch.testing.assert_close(moved[up].sum().item(), 0.5 * 0.25, rtol=1e-3, atol=0.0)
    torch.testing.assert_close(moved[down].sum().item(), -0.5 * 0.25, rtol=1e-3, atol=0.0)
    assert all(torch.equal(with_prior[key], without[key]) for key in without if key != "opacities")


BASELINES = ("3dgs", "3dgs-2023", "pup", "mini-splatting", "taming", "speedy-splat")
ENGINES = ("fast", "compiled")


def plan_of(method: str) -> DensityControl:
    return TrainConfig.of(method=method).strategy


def steps(asked: Callable[[int], bool], last: int = 40_000) -> list[int]:
    return [step for step in range(last) if asked(step)]


def test_every_method_densifies_and_resets_when_its_paper_says() -> None:
    for method in ("pop", "gsplat", "3dgs", "3dgs-2023", "pup", "speedy-splat"):
        plan = plan_of(method)
        assert steps(plan.is_refine_step) == list(range(600, 15_000, 100))
        assert len(steps(plan.is_refine_step)) == 144
        assert steps(plan.is_reset_step) == ([] if method == "pop" else [3_000, 6_000, 9_000, 12_000])
    assert steps(plan_of("pop").is_blur_step) == list(range(3_000, 7_001, 100))


def test_speedy_splat_prunes_softly_three_times_and_hard_five_times() -> None:
    plan = plan_of("speedy-splat")
    shares = {step: plan.prune_share_at(step) for step in steps(plan.needs_passes)}
    assert shares == {
        **dict.fromkeys((6_000, 9_000, 12_000), 0.8),
        **dict.fromkeys((15_000, 18_000, 21_000, 24_000, 27_000), 0.3),
    }


def test_mini_splatting_replaces_all_at_5000_and_10000_and_densifies_at_neither() -> None:
    plan = plan_of("mini-splatting")
    assert plan.adam_restarts == (5_000, 10_000, 15_000, 20_000)
    assert set(range(600, 15_000, 100)) - set(steps(plan.is_refine_step)) == {5_000, 10_000}
    assert steps(plan.is_reset_step) == []
    assert plan.collects_blur(0)
    assert not plan.collects_blur(15_000)


def test_taming_grows_28_times_along_a_parabola_that_ends_at_the_budget() -> None:
    plan = plan_of("taming")
    densified = steps(plan.is_refine_step)
    assert densified == list(range(1_000, 15_000, 500))
    assert len(densified) == 28
    assert [plan.densification_at(step) for step in densified] == list(range(1, 29))
    assert plan.n_densifications == 29
    assert taming.budget_at(29, plan.n_densifications, 1000, plan.target(1000)) == 2000


def test_pup_prunes_at_the_beginning_of_two_rounds_after_the_training() -> None:
    config = TrainConfig.of(method="pup")
    assert config.max_steps == 40_000
    assert steps(config.strategy.needs_passes) == [30_000, 35_000]
    assert config.strategy.prune_shares == (0.8, 0.5)


@pytest.mark.parametrize("method", sorted(set(METHODS) - {"gsplat"}))
def test_a_third_of_the_schedule_has_all_density_control(method: str) -> None:
    whole, third = TrainConfig.of(method=method), TrainConfig.of(method=method, steps_scaler=1 / 3)
    assert third.max_steps == pytest.approx(whole.max_steps / 3, abs=1)
    found, wanted = (steps(c.strategy.needs_passes, c.max_steps) for c in (third, whole))
    if method == "taming":
        assert len(found) == len(wanted) == 28
    else:
        assert found == [pytest.approx(step / 3, abs=1) for step in wanted]


def tiny_method(folder: Any, method: str, **changes: Any) -> TrainConfig:
    """Thirty steps of a method, with all its density control."""
    own: dict[str, dict[str, Any]] = {
        "pup": {"rounds_start_iter": 20, "round_steps": 5, "round_decay_every": 2, "prune_shares": (0.5, 0.25)},
        "mini-splatting": {
            "reinit_iters": (7,),
            "reinit_points": 240,
            "sample_iter": 18,
            "sampling_factor": 0.5,
            "prune_iter": 24,
            "prune_mass": 0.05,
            "blur_stop_iter": 18,
            "theta_blur": 0.02,
            "sh_start_iter": 12,
            "means_rewind_iter": 18,
            "means_rewind_to": 6,
        },
        "taming": {"opacities_stop_iter": 24, "sh_rest_every": 4, "score_views": 3, "sampled_prunes": 3},
        "speedy-splat": {"soft_prune_iters": (11,), "hard_prune_iters": (25,)},
    }
    refine = {"refine_start_iter": 3, "refine_stop_iter": 18, "refine_every": 4, "prune_too_big_after": 8}
    grow = {"grow_grad2d": 3e-3, "grow_scale3d": 0.05, "prune_opa": 0.05}
    kind, recipe, _ = METHODS[method]
    resets = {} if method == "mini-splatting" else {"reset_every": 12, "reset_opa": 0.2}
    strategy = kind(**refine, **grow, **resets, **own.get(method, {}))
    base = tiny_config(folder)
    settings = {"profile": recipe.profile.name, "photometric": "l1", "lambda_ssim": 0.2, "ssim_padding": "same"}
    return replace(base, strategy=strategy, **settings, **changes)


def engine_or_skip(backend: str) -> None:
    reason = get_backend(backend).why_not()
    if reason is not None:
        pytest.skip(reason)


@pytest.mark.parametrize("backend", ENGINES)
@pytest.mark.parametrize("method", BASELINES)
def test_a_run_that_is_stopped_anywhere_goes_on_to_the_same_bits(method: str, backend: str, tmp_path: Any) -> None:
    engine_or_skip(backend)
    config = tiny_method(tmp_path, method, backend=backend, checkpoint_every=1, keep_checkpoints=30)
    whole = TrainingRun(config, tiny_capture())
    assert np.isfinite(whole.run()["psnr"])
    for path in sorted((tmp_path / "ckpts").glob("ckpt_*"))[4::9]:
        step = int(path.stem.split("_")[1])
        for later in (tmp_path / "ckpts").glob("ckpt_*"):
            if int(later.stem.split("_")[1]) > step:
                later.unlink()
        again = TrainingRun(config, tiny_capture(), resume=True)
        again.run()
        assert all(torch.equal(again.params[key], whole.params[key]) for key in KEYS), f"after step {step}"


class Recorded:
    """Draws from one list of numbers, so that an oracle can be given the same."""

    def __init__(self, seed: int = 5) -> None:
        self.generator = np.random.default_rng(seed)
        self.drawn: list[np.ndarray] = []

    def draws(self) -> Draws:
        return Draws(lambda n: torch.tensor(self.generator.standard_normal((2, n, 3))), self.uniforms)

    def uniforms(self, n: int) -> Tensor:
        self.drawn.append(self.generator.random(n))
        return torch.tensor(self.drawn[-1])


def in_double(folder: Any, method: str, **changes: Any) -> tuple[TrainingRun, Recorded]:
    config = tiny_method(folder, method, **changes)
    start = TrainingRun(config, tiny_capture())
    initial = {key: value.detach().double() for key, value in start.params.items()}
    run, recorded = TrainingRun(config, tiny_capture(), initial=initial), Recorded()
    run.draws = recorded.draws()
    return run, recorded


def stopped_before(run: TrainingRun, step: int) -> None:
    while run.step < step:
        run.take_steps(run.step + 1)


def cameras_of(run: TrainingRun) -> list[tuple[Camera, np.ndarray]]:
    return [
        (Camera(view.viewmat[0].numpy(), view.K[0].numpy(), view.width, view.height), view.photo.numpy())
        for view in run._train
    ]


def arrays_of(run: TrainingRun) -> dict[str, np.ndarray]:
    return {key: value.detach().numpy().copy() for key, value in run.params.items()}


def hold_change(run: TrainingRun, step: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], Any]:
    """Hold density control after a step by itself, and return the parameters before and after it."""
    before = arrays_of(run)
    change = run._change(step)
    return before, arrays_of(run), change


def test_speedy_splat_removes_who_the_oracle_says(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "speedy-splat")
    stopped_before(run, 25)
    before, after, change = hold_change(run, 25)
    gaussians, profile, scores = gaussians_from_params(before), METHODS["speedy-splat"].recipe.profile, 0.0
    for camera, _ in cameras_of(run):
        drawn = render(gaussians, camera, profile=profile)
        size = (camera.width, camera.height, profile.tile_size)
        scores = scores + sensitivities(drawn.splats, drawn.tile_lists, *size, None, profile)
    gone = selection.lowest_share(scores, 0.3)
    assert 0 < change.pruned == gone.sum() < len(gone)
    for key in KEYS:
        np.testing.assert_array_equal(after[key], before[key][~gone])


def test_pup_removes_who_the_oracle_says_and_forgets_all_moments(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "pup")
    stopped_before(run, 20)
    before, after, change = hold_change(run, 20)
    gaussians, profile = gaussians_from_params(before), METHODS["pup"].recipe.profile
    blocks = np.zeros((len(gaussians), 6, 6))
    for whole, _ in cameras_of(run):
        width, height = -(-whole.width // 4), -(-whole.height // 4)
        K = whole.K * np.array([[width / whole.width], [height / whole.height], [1.0]])
        camera = Camera(whole.viewmat, K, width, height)
        drawn = render(gaussians, camera, profile=profile)
        size = (width, height, profile.tile_size)
        moments = fisher.screen_moments(drawn.splats, drawn.tile_lists, *size, None, profile)
        blocks += fisher.fisher_blocks(gaussians, camera, moments, None, profile)
    gone = selection.lowest_share(fisher.log_det_scores(blocks), 0.5)
    assert 0 < change.pruned == gone.sum() < len(gone)
    for key in KEYS:
        np.testing.assert_array_equal(after[key], before[key][~gone])
        moments = run.optimizers[key].state[run.params[key]]
        assert not any(value.any() for value in moments.values())


def test_mini_splatting_sets_points_where_the_oracle_does(tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "mini-splatting")
    stopped_before(run, 7)
    recorded.drawn.clear()
    before, after, change = hold_change(run, 7)
    gaussians, profile = gaussians_from_params(before), METHODS["mini-splatting"].recipe.profile
    views, points, colors = cameras_of(run), [], []
    for (camera, photo), uniforms in zip(views, recorded.drawn, strict=True):
        drawn = render(gaussians, camera, sh_degree=0, profile=profile)
        found = dominant_points(drawn.splats, drawn.tile_lists, gaussians, camera, profile.tile_size, profile)
        weights = np.where(found.ids >= 0, 1.0 - found.T_final, 0.0).ravel()
        wanted = mini_splatting.samples_per_view(len(views), camera.width, camera.height, 240)
        chosen = selection.sample_without_replacement(weights, min(wanted, int(np.sum(weights > 0))), uniforms)
        points.append(found.points.reshape(-1, 3)[chosen])
        colors.append(photo.reshape(-1, 3)[chosen] / 255.0)
    assert change.replaced == len(after["means"]) == sum(map(len, points)) > 100
    np.testing.assert_allclose(after["means"], np.concatenate(points), atol=1e-9)
    rgb = after["sh0"][:, 0] * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(rgb, np.concatenate(colors), atol=1e-12)
    np.testing.assert_allclose(after["scales"], mini_splatting.nearest_log_scales(after["means"]), atol=1e-9)
    np.testing.assert_allclose(after["opacities"], np.log(0.1 / 0.9), rtol=1e-12)
    assert not after["shN"].any()
    np.testing.assert_array_equal(after["quats"], np.tile([1.0, 0.0, 0.0, 0.0], (change.replaced, 1)))


@pytest.mark.parametrize("importance", ["indoor", "outdoor"])
def test_mini_splatting_draws_and_prunes_by_the_oracles_importance(importance: str, tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "mini-splatting")
    run.strategy = replace(run.strategy, importance=importance)
    profile = METHODS["mini-splatting"].recipe.profile

    def oracles(params: dict[str, np.ndarray], degree: int) -> np.ndarray:
        gaussians, seen = gaussians_from_params(params), []
        for camera, _ in cameras_of(run):
            drawn = render(gaussians, camera, sh_degree=degree, profile=profile)
            size = (camera.width, camera.height, profile.tile_size)
            seen.append((contributions(drawn.splats, drawn.tile_lists, *size, None, profile), drawn.dominant_counts))
        return mini_splatting.scene_importance(seen, importance == "outdoor")

    stopped_before(run, 18)
    recorded.drawn.clear()
    before, after, change = hold_change(run, 18)
    weights = oracles(before, 1)
    wanted = int(0.5 * np.sum(weights > 0))
    chosen = selection.sample_without_replacement(weights, wanted, recorded.drawn[0])
    assert change.replaced == wanted > 20
    np.testing.assert_array_equal(after["means"], before["means"][chosen])
    np.testing.assert_array_equal(after["sh0"], before["sh0"][chosen])
    run.step = 19
    stopped_before(run, 24)
    before, after, change = hold_change(run, 24)
    gone = selection.least_mass(oracles(before, 2), 0.05)
    assert 0 < change.pruned == gone.sum() < len(gone)
    np.testing.assert_array_equal(after["means"], before["means"][~gone])


@pytest.mark.parametrize("misaligned", [False, True])
def test_taming_grows_and_prunes_who_the_oracle_draws(misaligned: bool, tmp_path: Any) -> None:
    run, recorded = in_double(tmp_path, "taming")
    plan = run.strategy = replace(run.strategy, misaligned_prune_weights=misaligned, grow_grad2d=1e-4, prune_opa=0.6)
    stopped_before(run, 16)
    recorded.drawn.clear()
    # statistics of the window belong to the step before it
    state, draws = state_of(run), recorded.drawn
    before, after, change = hold_change(run, 16)
    views, gaussians = cameras_of(run), gaussians_from_params(before)
    chosen = [views[i] for i in np.argsort(draws[0], kind="stable")[:3]]
    grads = average_grads(state.statistics, plan)
    scores = taming.taming_scores(gaussians, chosen, grads, None, 2, METHODS["taming"].recipe.profile)
    small = gaussians.scales.max(1) <= plan.grow_scale3d * run.state["scene_scale"]
    candidates = grads >= plan.grow_grad2d
    budget = taming.budget_at(plan.densification_at(16), plan.n_densifications, 60, plan.target(60))
    quotas = taming.quotas(budget, len(grads), int((candidates & small).sum()), int((candidates & ~small).sum()))
    sampled = []
    for mask, quota, uniforms in zip((candidates & small, candidates & ~small), quotas, draws[1:3], strict=True):
        weights = np.where(mask, scores, 0.0)
        sampled.append(selection.sample_without_replacement(weights, min(quota, int(np.sum(weights > 0))), uniforms))
    assert (change.cloned, change.split) == tuple(map(len, sampled))
    assert change.cloned + change.split > 0
    kept = np.setdiff1d(np.arange(len(grads)), sampled[1])
    inverse = 1.0 / (1e-6 + scores)
    chances = np.zeros(len(draws[3]))
    first = inverse if misaligned else inverse[kept]
    chances[: len(first)] = first[: len(chances)]
    grown = np.concatenate([before["opacities"][kept], before["opacities"][sampled[0]]])
    grown = np.concatenate([grown, np.tile(before["opacities"][sampled[1]], 2)])
    faint = 1.0 / (1.0 + np.exp(-grown)) < plan.prune_opa
    drawn = selection.sample_without_replacement(chances, int(faint.sum()) // 2, draws[3])
    gone = faint & np.isin(np.arange(len(grown)), drawn)
    assert change.pruned == gone.sum() > 0
    np.testing.assert_array_equal(after["opacities"], grown[~gone])


def test_the_last_densification_step_of_taming_prunes_nothing(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "taming")
    run.strategy = replace(run.strategy, prune_opa=0.6, sampled_prunes=run.strategy.densification_at(16) - 1)
    stopped_before(run, 16)
    faint = (torch.sigmoid(run.params["opacities"].detach()) < 0.6).sum()
    assert hold_change(run, 16)[2].pruned == 0 < faint


def test_mini_splatting_splits_who_was_blurred_in_any_view_since_the_last_densification_step(tmp_path: Any) -> None:
    default = METHODS["mini-splatting"].strategy().blur_window
    runs = {window: in_double(tmp_path, "mini-splatting")[0] for window in (default, "own_view")}
    runs["own_view"].strategy = replace(runs["own_view"].strategy, blur_window="own_view")
    flags: dict[str, list[Tensor]] = {window: [] for window in runs}
    # the first densification step comes after step 4: until then both runs have the same Gaussians
    for step in range(1, 5):
        for window, run in runs.items():
            run.take_steps(step)
            flags[window].append(run.state["blurred"].bool().clone())
    of_own_views = torch.stack(flags["own_view"])
    assert torch.equal(flags[default][-1], of_own_views.any(0))
    assert not torch.equal(of_own_views.any(0), of_own_views[-1])


@pytest.mark.parametrize(
    ("method", "setting", "words"),
    [
        ("speedy-splat", {"hard_prune_share": 1.5}, "speedy-splat.hard_prune_share is 1.5; it must lie in [0, 1]"),
        ("pup", {"prune_shares": (0.5, -0.1)}, "pup.prune_shares is -0.1; it must lie in [0, 1]"),
        ("pup", {"score_divisor": 0}, "pup.score_divisor is 0; it must be at least 1"),
        (
            "mini-splatting",
            {"reinit_opacity": 1.0},
            "mini-splatting.reinit_opacity is 1.0; it must lie between 0 and 1",
        ),
        ("taming", {"sh_rest_every": 0}, "taming.sh_rest_every is 0; it must be at least 1"),
        ("taming", {"budget_multiplier": -2.0}, "taming.budget_multiplier is -2.0; it must be >= 0 and finite"),
        ("pop", {"refine_every": 0}, "pop.refine_every is 0; it must be at least 1"),
    ],
)
def test_a_setting_that_cannot_be_is_named_as_the_command_line_names_it(
    method: str, setting: dict[str, Any], words: str
) -> None:
    with pytest.raises(PopError) as error:
        TrainConfig.of(method=method, **{method: setting})
    assert str(error.value) == words


def test_a_method_that_looks_at_the_views_says_so_to_a_trainer_that_has_none(tmp_path: Any) -> None:
    run, _ = in_double(tmp_path, "speedy-splat")
    stopped_before(run, 25)
    with pytest.raises(ValueError, match="this strategy looks at the training views"):
        run.strategy.change(run.params, run.optimizers, run.state, 25)
