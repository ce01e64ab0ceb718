"""The settings of a run: the paper's numbers, shrinking, JSON, and what a resumed run must share."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.errors import PopError
from pop_fast.strategies import ADCStrategy, POPStrategy
from pop_fast.train import LearningRates, TrainConfig
from pop_fast.train.config import first_difference
from pop_fast.train.schedule import ViewOrder, active_sh_degree, means_lr


def test_the_defaults_are_the_papers_schedule():
    config = TrainConfig()
    assert (config.max_steps, config.sh_degree, config.sh_interval, config.test_every) == (30_000, 3, 1000, 8)
    assert (config.pop.pop_start_iter, config.pop.pop_stop_iter, config.pop.lambda_pop) == (0, 15_000, 1e-3)
    assert (config.pop.blur_start_iter, config.pop.blur_stop_iter, config.pop.theta_blur) == (3000, 7000, 2e-5)
    assert (config.photometric_at(29_999), config.ssim_padding) == (("l2", 0.01), "valid")
    lr = config.lr
    assert (lr.means, lr.means_decay, lr.scales, lr.quats, lr.opacities) == (1.6e-4, 0.01, 5e-3, 1e-3, 5e-2)
    assert (lr.sh0, lr.sh_rest) == (2.5e-3, 1.25e-4)


def test_the_plain_method_has_its_own_loss_unless_told_otherwise():
    config = TrainConfig(method="adc")
    assert config.photometric_at(0) == ("l1", 0.2)
    config = replace(config, photometric="l2", lambda_ssim=0.05)
    assert config.photometric_at(0) == ("l2", 0.05)
    assert isinstance(config.strategy, ADCStrategy)
    assert isinstance(TrainConfig().strategy, POPStrategy)


def test_eq_2_takes_over_where_the_l2_loss_is_said_to_stop():
    config = TrainConfig(l2_stop_iter=15_000, preset="quick").resolved()
    assert config.photometric_at(1499) == ("l2", 0.01)
    assert config.photometric_at(1500) == ("l1", 0.2)
    with pytest.raises(PopError, match="l2_stop_iter is -1"):
        TrainConfig(l2_stop_iter=-1)


def test_shrinking_multiplies_every_step_number_and_no_rate():
    quick = TrainConfig(preset="quick").resolved()
    assert (quick.max_steps, quick.sh_interval) == (3000, 100)
    assert quick.eval_steps == quick.save_steps == (700, 3000)
    assert (quick.pop.blur_start_iter, quick.pop.blur_stop_iter, quick.pop.pop_stop_iter) == (300, 700, 1500)
    assert (quick.adc.reset_every, quick.adc.refine_stop_iter) == (300, 1500)
    assert quick.lr == LearningRates()
    assert not quick.pop.prune_too_big
    assert not quick.adc.prune_too_big
    assert quick.resolved() == quick
    assert TrainConfig(preset="quick", steps_scaler=0.5).resolved().max_steps == 15_000


def test_a_shrunk_paper_schedule_still_prunes_by_size():
    shrunk = TrainConfig(steps_scaler=0.1).resolved()
    assert shrunk.pop.prune_too_big
    assert shrunk.adc.prune_too_big


def test_max_steps_alone_cuts_the_schedule_short():
    config = TrainConfig(max_steps=7000).resolved()
    assert (config.max_steps, config.pop.blur_stop_iter) == (7000, 7000)


def test_the_means_rate_falls_log_linearly_to_a_hundredth():
    assert means_lr(0, 100, 2.0, 0.01) == 2.0
    assert means_lr(50, 100, 2.0, 0.01) == pytest.approx(0.2)
    assert means_lr(100, 100, 2.0, 0.01) == means_lr(200, 100, 2.0, 0.01) == pytest.approx(0.02)


def test_colour_bands_open_one_every_interval():
    assert [active_sh_degree(s, 1000, 3) for s in (0, 999, 1000, 2999, 3000, 29_999)] == [0, 0, 1, 2, 3, 3]
    assert active_sh_degree(5000, 1000, 1) == 1


def test_every_epoch_shows_every_view_once():
    order = ViewOrder(7, seed=0)
    epochs = [[order.next() for _ in range(7)] for _ in range(3)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_a_view_order_goes_on_where_it_was_saved():
    order, other = ViewOrder(5, seed=1), ViewOrder(5, seed=2)
    for _ in range(8):
        order.next()
    other.load_state_dict(order.state_dict())
    assert [order.next() for _ in range(12)] == [other.next() for _ in range(12)]


@given(
    config=st.builds(
        TrainConfig,
        method=st.sampled_from(["pop", "adc"]),
        preset=st.sampled_from(["paper", "quick"]),
        steps_scaler=st.none() | st.floats(0.01, 2.0),
        lambda_ssim=st.none() | st.floats(0.0, 1.0),
        background=st.tuples(*[st.floats(0.0, 1.0)] * 3),
        eval_steps=st.lists(st.integers(1, 10**6)).map(tuple),
        lpips_vgg=st.lists(st.text()).map(tuple),
        data=st.text(),
        pop=st.builds(POPStrategy, theta_blur=st.floats(0, 1), blur_window=st.sampled_from(["any_view", "sum"])),
        adc=st.builds(ADCStrategy, inclusive=st.booleans(), reset_every=st.integers(0, 10**6)),
    )
)
def test_settings_go_through_json_unchanged(config):
    assert TrainConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_stepz": 3}, r"config\.max_stepz is not a setting"),
        ({"max_steps": "many"}, r"config\.max_steps is 'many'; it must be a whole number"),
        ({"max_steps": 2.5}, r"config\.max_steps is 2\.5; it must be a whole number"),
        ({"seed": True}, r"config\.seed is True; it must be a whole number"),
        ({"method": "magic"}, r"config\.method is 'magic'; it must be one of 'pop', 'adc'"),
        ({"background": [0, 0]}, r"config\.background has 2 values; it must have 3"),
        ({"background": 0}, r"config\.background is 0; it must be a list"),
        ({"eval_steps": [7, None]}, r"config\.eval_steps\[1\] is None; it must be a whole number"),
        ({"pop": {"theta_blur": "x"}}, r"config\.pop\.theta_blur is 'x'; it must be a number"),
        ({"adc": []}, r"config\.adc is \[\]; it must be an object"),
        ({"max_steps": 0}, r"max_steps is 0; it must be at least 1"),
        ({"background": [0, 0, 2]}, r"background is \[0\.0, 0\.0, 2\.0\]"),
        ({"steps_scaler": 0}, r"steps_scaler is 0\.0; it must be > 0"),
        ({"sh_degree": 4}, r"sh_degree is 4"),
        ({"init_opacity": 1}, r"init_opacity is 1\.0"),
        ({"lambda_ssim": 1.5}, r"lambda_ssim is 1\.5"),
        ({"steps_scaler": float("inf")}, r"steps_scaler is inf; it must be > 0 and finite"),
        ({"steps_scaler": 1e300}, r"steps_scaler is 1e\+300; it must be at most 1000000"),
        ({"init_scale": float("inf")}, r"init_scale is inf; it must be > 0 and finite"),
        ({"photometric_divisor": float("inf")}, r"photometric_divisor is inf"),
        ({"lr": {"means": -1}}, r"lr\.means is -1\.0; it must be >= 0 and finite"),
        ({"lr": {"means": float("nan")}}, r"lr\.means is nan"),
        ({"lr": {"means_decay": -1}}, r"lr\.means_decay is -1\.0; it must be > 0 and finite"),
        ({"lr": {"means_decay": 0}}, r"lr\.means_decay is 0\.0; it must be > 0"),
        ({"pop": {"lambda_pop": float("nan")}}, r"pop\.lambda_pop is nan; it must be >= 0 and finite"),
        ({"pop": {"prune_opa": 2}}, r"pop\.prune_opa is 2\.0; it must lie in \[0, 1\]"),
        ({"adc": {"grow_grad2d": float("inf")}}, r"adc\.grow_grad2d is inf"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(PopError, match=message):
        TrainConfig.from_json(json.dumps(change))


@pytest.mark.parametrize("name", [field.name for field in fields(LearningRates)])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_every_learning_rate_is_finite_and_not_negative(name, value):
    with pytest.raises(PopError, match=rf"lr\.{name} is {value}; it must be"):
        TrainConfig(lr=LearningRates(**{name: value}))


def test_what_is_not_json_is_said_with_its_place():
    with pytest.raises(PopError, match="line 1, column 2"):
        TrainConfig.from_json("{oops")


def test_a_resumed_run_must_share_what_reaches_the_bits_and_only_that():
    config = TrainConfig()
    free = {"data": "x", "result_dir": "y", "eval_steps": (1,), "progress": False, "max_renders": 0}
    assert first_difference(config.binding(), replace(config, **free).binding()) is None
    assert replace(config, **free).digest() == config.digest()
    for name, value in {"seed": 1, "max_steps": 7, "factor": 2, "backend": "ref", "log_every": 3}.items():
        found = first_difference(config.binding(), replace(config, **{name: value}).binding())
        assert found == (name, getattr(config, name), value)
    other = replace(config, pop=replace(config.pop, theta_blur=1e-4))
    assert first_difference(config.binding(), other.binding()) == ("pop.theta_blur", 2e-5, 1e-4)
    assert other.digest() != config.digest()
    # the settings of the method that is not run do not count
    assert first_difference(config.binding(), replace(config, adc=ADCStrategy(reset_every=1)).binding()) is None


def test_two_ways_to_say_the_same_schedule_are_the_same_run():
    spelled_out = TrainConfig(steps_scaler=0.1, pop=POPStrategy(blur_min_pixels=11.0, prune_too_big=False))
    assert TrainConfig(preset="quick").digest() == spelled_out.digest()
    assert TrainConfig(preset="quick").digest() != TrainConfig(steps_scaler=0.1).digest()


def test_every_setting_is_documented():
    for kind in (TrainConfig, POPStrategy, ADCStrategy):
        text = "".join(cls.__doc__ or "" for cls in kind.__mro__)
        missing = [f.name for f in fields(kind) if f"{f.name}:" not in text]
        assert not missing
