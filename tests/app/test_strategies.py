"""The strategies: their schedules, their protocol, what they ask for and refuse."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields

import pytest
import torch

from pop_fast.density import GsplatStrategy, InriaStrategy, POPStrategy, Strategy
from pop_fast.density.control import SHORTEST_REFINE_EVERY
from pop_ref.recipes import RECIPES
from pop_ref.settings import PopTerm
from tests.app.populations import densified_at, make, make_info


@pytest.mark.parametrize("strategy", [POPStrategy(), GsplatStrategy()])
def test_the_population_changes_144_times_from_600_to_14900(strategy):
    steps = [s for s in range(30_000) if strategy.is_refine_step(s)]
    assert (len(steps), steps[0], steps[-1]) == (144, 600, 14_900)


def test_blur_is_looked_at_41_times_both_ends_included():
    steps = [s for s in range(30_000) if POPStrategy().is_blur_step(s)]
    assert (len(steps), steps[0], steps[-1]) == (41, 3000, 7000)


def test_plain_control_resets_four_times_and_pop_never():
    assert [s for s in range(30_000) if GsplatStrategy().is_reset_step(s)] == [3000, 6000, 9000, 12_000]
    assert not any(POPStrategy().is_reset_step(s) for s in range(30_000))


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
