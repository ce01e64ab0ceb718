"""The settings of a run: the paper's numbers, shrinking, JSON, what a resumed run must share, and what a run chooses.

A run chooses where no schedule is said; its photographs may come as a video or in an archive.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pop_fast.cli.train import arguments
from pop_fast.cli.train_options import chooses_for_itself
from pop_fast.data.capture import Capture
from pop_fast.data.unpack import capture_folder, unpack
from pop_fast.density import DensityControl, GsplatStrategy, POPStrategy
from pop_fast.errors import CaptureError, PopError
from pop_fast.train import LearningRates, TrainConfig, automatic
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.automatic import (
    DEPTH_LAMBDAS,
    FEW,
    LOOKS,
    MINUTES,
    SHORTEST,
    Choice,
    Speed,
    Terms,
    choose_length,
    choose_terms,
    expected_gaussians,
    factor_for,
)
from pop_fast.train.choose import LAUNCHED
from pop_fast.train.config import first_difference
from pop_fast.train.load_result import Splat
from pop_fast.train.presets import (
    METHODS,
    QUICK_BETA2_UNTIL,
    QUICK_RATES,
    QUICK_SCALER,
    Given,
    options_for,
    to_plain,
    words_of,
)
from pop_fast.train.results import read_config
from pop_fast.train.schedule import ViewOrder, active_sh_degree, updates_of
from pop_fast.view.paths import VideoFile
from pop_fast.view.report.source import read_result
from pop_ref.constants import PROFILES
from pop_ref.density import densifies_at
from pop_ref.optimizer import learning_rates, update_numbers
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES
from pop_ref.settings import PARAMETERS, AppearanceRates, DensityConfig, Objective, PopTerm, UpdateRules
from tests.app.conftest import Pop
from tests.app.damage import says
from tests.app.tiny import interrupt, tiny_capture


def test_the_defaults_are_the_papers_schedule():
    config = TrainConfig()
    assert_trains(config, RECIPES["POP"])
    assert (config.max_steps, config.sh_degree, config.test_every, config.factor) == (30_000, 3, 8, 1)
    assert config.objective_at(29_999) == Objective(pixelwise="l2", lambda_ssim=0.01, padding="valid")
    for same in (TrainConfig.of(), TrainConfig.of(preset="paper")):
        assert replace(same, given=None) == config


def test_the_controls_are_two_methods_with_constants_of_their_own():
    gsplat, inria = TrainConfig.of(method="gsplat"), TrainConfig.of(method="3dgs")
    for control, name in ((gsplat, "gsplat"), (inria, "3DGS")):
        assert_trains(control, RECIPES[name])
    assert (gsplat.method, inria.method, TrainConfig().method) == ("gsplat", "3dgs", "pop")
    assert TrainConfig.of(method="adc") == gsplat
    said = TrainConfig.of(method="gsplat", photometric="l2", lambda_ssim=0.05)
    assert said.objective_at(0) == Objective(pixelwise="l2", lambda_ssim=0.05)


def test_eq_2_takes_over_where_the_l2_loss_is_said_to_stop():
    config = TrainConfig.of(l2_stop_iter=1500, preset="quick")
    assert config.objective_at(1499) == Objective()
    assert config.objective_at(1500) == Objective(pixelwise="l1", lambda_ssim=0.2)


def test_quick_is_a_short_schedule_with_the_papers_weights_and_its_own_rates():
    quick = TrainConfig.of(preset="quick")
    plan = quick.strategy
    assert (quick.max_steps, quick.sh_interval) == (1500, 50)
    assert quick.eval_steps == quick.save_steps == (350, 1500)
    assert (plan.blur_start_iter, plan.blur_stop_iter, plan.pop_stop_iter) == (150, 350, 750)
    assert (plan.lambda_pop, plan.blur_min_pixels, plan.prune_too_big) == (0.001, 10.0, False)
    assert (plan.refine_every, plan.grow_grad2d) == (50, pytest.approx(1.5e-4))
    assert quick.coarse_stop_iters == (250, 500)
    rates, usual = quick.lr, LearningRates()
    assert (rates.means / usual.means, rates.sh0 / usual.sh0, rates.others_decay) == pytest.approx((12.0, 8.0, 0.1))
    assert (rates.opacities, rates.means_decay, rates.beta2) == (usual.opacities, usual.means_decay, 0.99)
    control = TrainConfig.of(preset="quick", method="gsplat").strategy
    assert (control.refine_stop_iter, control.reset_every, control.prune_too_big_after) == (750, 3000, 3000)


@pytest.mark.parametrize("method", METHODS)
def test_what_quick_has_of_its_own_reaches_no_other_preset(method):
    paper = TrainConfig.of(method=method)
    short = TrainConfig.of(method=method, steps_scaler=0.05)
    for config in (paper, short):
        assert (config.coarse_stop_iters, config.lr) == ((), METHODS[method].recipe.lr)
        assert config.strategy.grow_grad2d == METHODS[method].strategy().grow_grad2d
        assert config.strategy.refine_every >= 100
    # large Gaussians are pruned by every method but POP, and after a reset interval
    for preset in ("paper", "quick"):
        plan = TrainConfig.of(method=method, preset=preset).strategy
        assert (plan.prune_too_big, plan.prune_too_big_after) == (method != "pop", 3000)
    # a setting that is at its published value is not among those that decide the bits of older checkpoints
    own = {"coarse_stop_iters", "lr.others_decay", "lr.beta2"}
    assert not own & set(paper.binding())
    assert own <= set(TrainConfig.of(method=method, preset="quick").binding())
    assert TrainConfig.of(preset="quick", steps_scaler=0.5).max_steps == 15_000
    assert TrainConfig.of(preset="quick", scale_lambda_pop=True).strategy.lambda_pop == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("said", "read"),
    [
        ({"max_steps": 50}, lambda config: config.max_steps),
        ({"sh_interval": 77}, lambda config: config.sh_interval),
        ({"eval_steps": (5, 9)}, lambda config: config.eval_steps),
        ({"pop.blur_min_pixels": 3.0}, lambda config: config.strategy.blur_min_pixels),
        ({"pop.lambda_pop": 0.002}, lambda config: config.strategy.lambda_pop),
        ({"pop.prune_too_big": True}, lambda config: config.strategy.prune_too_big),
        ({"strategy.reset_every": 300}, lambda config: config.strategy.reset_every),
        ({"lr.opacities": 0.01}, lambda config: config.lr.opacities),
    ],
)
def test_a_preset_gives_defaults_and_what_is_said_is_taken_literally(said, read):
    config = TrainConfig.of(preset="quick", scale_lambda_pop=True, steps_scaler=0.05, **said)
    assert read(config) == next(iter(said.values()))
    assert config.given.settings == {name.replace("strategy.", "pop."): to_plain(v) for name, v in said.items()}


SCHEDULES = st.fixed_dictionaries(
    {
        "method": st.sampled_from(list(METHODS)),
        "preset": st.sampled_from(["paper", "quick"]),
        "steps_scaler": st.none() | st.floats(0.01, 2.0),
        "scale_lambda_pop": st.booleans(),
    }
)
NESTED = {"strategy": DensityControl, "lr": LearningRates, "appearance_lr": AppearanceRates}
NAMES = [f.name for f in fields(TrainConfig) if f.name not in ("given", *NESTED)]
NAMES += [f"{group}.{f.name}" for group, kind in NESTED.items() for f in fields(kind)]


def value_of(config, name):
    group, dot, inner = name.partition(".")
    return getattr(getattr(config, group), inner) if dot else getattr(config, name)


def another(value, hint):
    """Make a value that a setting may have, and that no default is."""
    if get_origin(hint) is Literal:
        return next(choice for choice in get_args(hint) if choice != value)
    if isinstance(value, bool):
        return not value
    if get_origin(hint) is tuple:
        # steps ascend and a colour has three channels
        return {int: (3, 7), str: ("x",), float: (0.25, 0.5, 0.75)}[get_args(hint)[0]]
    if isinstance(value, str):
        # of backends, profiles and losses, which are names in tables, another one that there is
        of_tables = {"auto": "ref", "paper": "inria", "inria": "paper", "l2": "l1", "l1": "l2"}
        return of_tables.get(value, value + "x")
    if isinstance(value, float):
        return 0.625 if value != 0.625 else 0.375
    return 2 if value != 2 else 3


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=5)
@given(plan=SCHEDULES)
def test_the_users_word_wins_over_every_default(name, plan):
    group, dot, inner = name.partition(".")
    kind = NESTED[group] if dot else TrainConfig
    base = TrainConfig.of(**plan)
    value = another(value_of(base, name), get_type_hints(kind)[inner if dot else name])
    config = TrainConfig.of(**plan, **{name: value})
    assert value_of(config, name) == value
    # and it changes nothing else
    assert [other for other in NAMES if value_of(config, other) != value_of(base, other)] == [name]
    assert TrainConfig.from_json(config.to_json()) == config


def test_the_same_word_wins_on_the_command_line():
    words = ["scene", "--preset", "quick", "--max-steps", "50", "--pop.blur_min_pixels=3", "--pop.prune-too-big"]
    config, _ = arguments([*words, "--eval-steps", "5", "9", "--sh-interval", "100", "--no-normalize"])
    plan = config.strategy
    assert (config.max_steps, plan.blur_min_pixels, plan.prune_too_big) == (50, 3.0, True)
    assert (config.eval_steps, config.sh_interval, config.normalize) == ((5, 9), 100, False)
    # what was said is on record also where it is the default, and nothing else is
    assert config.given.settings == {
        "data": "scene",
        "max_steps": 50,
        "eval_steps": [5, 9],
        "sh_interval": 100,
        "normalize": False,
        "pop.blur_min_pixels": 3.0,
        "pop.prune_too_big": True,
    }
    control, _ = arguments(["scene", "--method", "adc", "--adc.reset-every", "0", "--steps_scaler=0.2"])
    assert (control.method, control.strategy.reset_every, control.max_steps) == ("gsplat", 0, 6000)
    assert arguments(["scene", "--method=3dgs", "--3dgs.reset-every", "300"])[0].strategy.reset_every == 300


def test_a_label_cannot_be_carried_by_settings_that_do_not_follow_it():
    quick = TrainConfig.of(preset="quick")
    with pytest.raises(PopError, match=r"max_steps is 5, but preset 'quick' and its explicit settings make it 1500"):
        replace(quick, max_steps=5)
    with pytest.raises(PopError, match="max_steps is 30000, but preset 'quick'"):
        TrainConfig(given=quick.given)
    cut = quick.with_overrides(max_steps=5, seed=3).with_overrides(**{"pop.lambda_pop": 0.5})
    assert (cut.max_steps, cut.seed, cut.strategy.lambda_pop, cut.preset) == (5, 3, 0.5, "quick")
    assert cut.given.settings == {"max_steps": 5, "seed": 3, "pop.lambda_pop": 0.5}
    # where it runs and where it writes is not part of a preset
    assert replace(quick, result_dir="x", backend="fast").with_overrides(seed=1).result_dir == "x"
    assert TrainConfig().preset is None
    exposed = replace(quick, appearance_lr=AppearanceRates(exposures=0.5))
    learned = exposed.with_overrides(**{"appearance_lr.cameras": 0.1})
    assert learned.appearance_lr == AppearanceRates(exposures=0.5, cameras=0.1)
    # what was run is read back also where the preset has other values now
    written = json.loads(quick.to_json())
    written["resolved"]["max_steps"] = 2500
    read = TrainConfig.from_json(json.dumps(written))
    assert (read.max_steps, read.preset) == (2500, None)


@pytest.mark.parametrize("recipe", [*RECIPES.values(), *BASELINES.values()], ids=[*RECIPES, *BASELINES])
def test_a_run_moves_whom_the_oracle_moves_when_and_as_far(recipe):
    rules = replace(
        recipe.updates,
        sh_start_iter=recipe.updates.sh_start_iter // 200,
        opacities_stop_iter=recipe.updates.opacities_stop_iter // 200,
        means_rewind_iter=recipe.updates.means_rewind_iter // 200,
        means_rewind_to=recipe.updates.means_rewind_to // 200,
        rounds_start_iter=recipe.updates.rounds_start_iter // 200,
        round_steps=25,
        round_decay_every=4,
    )
    density = replace(recipe.density, refine_start_iter=5, refine_stop_iter=75, refine_every=7)
    short = replace(
        recipe,
        density=density,
        updates=rules,
        max_steps=recipe.max_steps // 200,
        adam_restarts=tuple(step // 200 for step in recipe.adam_restarts),
    )
    edits = [step for step in range(short.max_steps) if densifies_at(step, density)]
    found = updates_of(short.lr, 2.5, short.max_steps, rules, edits, short.adam_restarts)
    for step in range(short.max_steps):
        wanted = learning_rates(step, 2.5, short.max_steps, short.lr, rules)
        assert found.rates[step].tolist() == pytest.approx([wanted[name] for name in PARAMETERS], rel=1e-14)
        numbers = update_numbers(PARAMETERS, step, short)
        assert found.numbers[step].tolist() == [numbers.get(name, 0) for name in PARAMETERS]


def test_restarts_outside_the_run_and_twice_at_a_step_change_no_update():
    rules = UpdateRules(edits_replace_update=True)
    some = updates_of(LearningRates(), 1.0, 12, rules, [3], [7])
    more = updates_of(LearningRates(), 1.0, 12, rules, [-1, 3, 40], [-1, 7, 7, 12])
    assert some.numbers.equal(more.numbers)
    assert some.numbers[:, 0].tolist() == [1, 2, 3, 0, 4, 5, 6, 0, 1, 2, 3, 4]


def test_colour_bands_open_one_every_interval():
    assert [active_sh_degree(s, 1000, 3) for s in (0, 999, 1000, 2999, 3000, 29_999)] == [0, 0, 1, 2, 3, 3]
    assert active_sh_degree(5000, 1000, 1) == 1
    assert [active_sh_degree(s, 1000, 3, 15_000) for s in (0, 15_999, 16_000, 18_000)] == [0, 0, 1, 3]
    # a checkpoint has room for all bands, also where a run opens fewer
    rows = {"shN": torch.zeros(1, 15, 3)}
    drawn = {
        n: Splat(path=Path(), params=rows, config=TrainConfig(sh_degree=n), step=9000, folder=Path()) for n in (0, 1, 3)
    }
    assert [splat.sh_degree for splat in drawn.values()] == [0, 1, 3]


def test_every_epoch_shows_every_view_once_and_goes_on_where_it_was_saved():
    order, other = ViewOrder(7, seed=0), ViewOrder(7, seed=2)
    epochs = [[order.next() for _ in range(7)] for _ in range(3)]
    assert all(sorted(epoch) == list(range(7)) for epoch in epochs)
    assert epochs[0] != epochs[1]
    order.next()
    other.load_state_dict(order.state_dict())
    assert [order.next() for _ in range(12)] == [other.next() for _ in range(12)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_stepz": 3}, r"config\.max_stepz is not a setting"),
        ({"max_steps": "many"}, r"config\.max_steps is 'many'; it must be a whole number"),
        ({"max_steps": 2.5}, r"config\.max_steps is 2\.5; it must be a whole number"),
        ({"seed": True}, r"config\.seed is True; it must be a whole number"),
        ({"method": "magic"}, r"config\.method is 'magic'; it must be one of 'pop', 'gsplat', '3dgs'"),
        ({"background": [0, 0]}, r"config\.background has 2 values; it must have 3"),
        ({"background": 0}, r"config\.background is 0; it must be a list"),
        ({"eval_steps": [7, None]}, r"config\.eval_steps\[1\] is None; it must be a whole number"),
        ({"strategy": {"theta_blur": "x"}}, r"config\.pop\.theta_blur is 'x'; it must be a number"),
        ({"strategy": []}, r"config\.pop is \[\]; it must be an object"),
        ({"max_steps": 0}, r"max_steps is 0; it must be at least 1"),
        ({"l2_stop_iter": -1}, r"l2_stop_iter is -1"),
        ({"background": [0, 0, 2]}, r"background is \[0\.0, 0\.0, 2\.0\]"),
        ({"sh_degree": 4}, r"sh_degree is 4"),
        ({"init_opacity": 1}, r"init_opacity is 1\.0"),
        ({"lambda_ssim": 1.5}, r"lambda_ssim is 1\.5"),
        ({"init_scale": float("inf")}, r"init_scale is inf; it must be > 0 and finite"),
        ({"photometric_divisor": float("inf")}, r"photometric_divisor is inf"),
        ({"lr": {"means_decay": 0}}, r"lr\.means_decay is 0\.0; it must be > 0"),
        ({"strategy": {"lambda_pop": float("nan")}}, r"pop\.lambda_pop is nan; it must be >= 0 and finite"),
        ({"strategy": {"prune_opa": 2}}, r"pop\.prune_opa is 2\.0; it must lie in \[0, 1\]"),
        ({"method": "gsplat", "strategy": {"grow_grad2d": float("inf")}}, r"gsplat\.grow_grad2d is inf"),
        ({"strategy": {"refine_every": 0}}, r"pop\.refine_every is 0; it must be at least 1"),
        ({"strategy": {"reset_opa": 0}}, r"pop\.reset_opa is 0\.0; it must lie between 0 and 1"),
        ({"strategy": {"reset_opa": 1}}, r"pop\.reset_opa is 1\.0; it must lie between 0 and 1"),
    ],
)
def test_bad_settings_are_named(change, message):
    with pytest.raises(PopError, match=message):
        TrainConfig.from_json(json.dumps({"given": None, "resolved": change}))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        ({"steps_scaler": 0}, r"steps_scaler is 0\.0; it must be > 0"),
        ({"steps_scaler": float("inf")}, r"steps_scaler is inf; it must be > 0 and finite"),
        ({"steps_scaler": 1e300}, r"steps_scaler is 1e\+300; it must lie in \[1e-06, 1000000\]"),
        # of such a number a run that had flushed denormals to 0 could not read its own cfg.json
        ({"steps_scaler": 1e-320}, r"steps_scaler is 1e-320; it must lie in \[1e-06, 1000000\]"),
        ({"preset": "slow"}, r"config\.preset is 'slow'; it must be one of 'paper', 'quick'"),
        ({"method": "magic"}, r"config\.method is 'magic'; it must be one of 'pop', 'gsplat', '3dgs'"),
        ({"max_stepz": 3}, r"config\.max_stepz is not a setting"),
        ({"pop.lambda": 3}, r"config\.pop\.lambda is not a setting"),
        ({"strategy": GsplatStrategy()}, "strategy is a GsplatStrategy, but the method is 'pop'"),
        ({"gsplat.reset_every": 3}, r"config\.gsplat\.reset_every is not a setting"),
    ],
)
def test_bad_words_are_named(plan, message):
    with pytest.raises(PopError, match=message):
        TrainConfig.of(**plan)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *((json.dumps(other), "older version.*train again") for other in ({"max_steps": 3}, [], {"resolved": []})),
        ("{oops", "line 1, column 2"),
    ],
)
def test_settings_of_another_layout_are_named_with_what_to_do(text, message, tmp_path):
    (tmp_path / "cfg.json").write_text(text)
    with pytest.raises(PopError, match=rf"cfg\.json: .*{message}") as error:
        read_config(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [field.name for field in fields(LearningRates)])
def test_every_learning_rate_is_finite_and_not_negative(name):
    own = {"means_decay": "be > 0 and finite", "others_decay": "be > 0 and finite", "beta2": "lie between 0 and 1"}
    ought = own.get(name, "be >= 0 and finite")
    for value in (-1.0, float("nan"), float("inf")):
        with pytest.raises(PopError, match=rf"lr\.{name} is {value}; it must {ought}"):
            TrainConfig(lr=LearningRates(**{name: value}))


def test_a_resumed_run_must_share_what_reaches_the_bits_and_only_that():
    config = TrainConfig()
    free = {"data": "x", "result_dir": "y", "eval_steps": (1,), "progress": False, "max_renders": 0}
    assert first_difference(config.binding(), replace(config, **free).binding()) is None
    assert replace(config, **free).digest() == config.digest()
    for name, value in {"seed": 1, "max_steps": 7, "factor": 2, "backend": "ref", "log_every": 3}.items():
        found = first_difference(config.binding(), replace(config, **{name: value}).binding())
        assert found == (name, getattr(config, name), value)
    other = replace(config, strategy=replace(config.strategy, theta_blur=1e-4))
    assert first_difference(config.binding(), other.binding()) == ("pop.theta_blur", 2e-5, 1e-4)
    assert other.digest() != config.digest()
    assert first_difference(config.binding(), TrainConfig.of(method="gsplat").binding()) == ("method", "pop", "gsplat")
    # what checkpoints leave out as every run had it is said as it was
    four = replace(config, batch_size=4)
    assert first_difference(config.binding(), four.binding()) == ("batch_size", 1, 4)
    assert first_difference(four.binding(), config.binding()) == ("batch_size", 4, 1)


def test_two_ways_to_say_the_same_schedule_are_the_same_run():
    usual = LearningRates()
    rates = {name: factor * getattr(usual, name) for name, factor in QUICK_RATES.items()}
    spelled_out = TrainConfig.of(
        steps_scaler=0.05,
        coarse_stop_iters=(250, 500),
        lr={**rates, "others_decay": 0.1, "beta2": 0.99},
        **{"pop.blur_min_pixels": 10.0, "pop.refine_every": 50, "pop.grow_grad2d": 0.75 * POPStrategy().grow_grad2d},
    )
    assert TrainConfig.of(preset="quick").digest() == spelled_out.digest()
    assert TrainConfig.of(preset="quick").digest() != TrainConfig.of(steps_scaler=0.05).digest()


def test_every_setting_is_documented():
    for kind in (TrainConfig, Given, POPStrategy, GsplatStrategy):
        text = "".join(cls.__doc__ or "" for cls in kind.__mro__)
        assert not [f.name for f in fields(kind) if f"{f.name}:" not in text]


# The rows of the paper's tables as options of `pop train`: each trains what the oracle's recipe of that name says.

ROWS = {**RECIPES, **{f"L1 div {n}": recipe for n, recipe in L1_DIVIDED.items()}}


def assert_trains(config, recipe):
    for kind, said in ((DensityConfig, recipe.density), (PopTerm, recipe)):
        for field in fields(kind):
            assert getattr(config.strategy, field.name) == getattr(said, field.name), field.name
    photometric = (config.photometric, config.lambda_ssim, config.l2_stop_iter, config.ssim_padding)
    assert photometric == (recipe.pixelwise, recipe.lambda_ssim, recipe.l2_stop_iter, recipe.padding)
    assert config.photometric_divisor == pytest.approx(1.0 / recipe.pixel_scale, rel=1e-15)
    assert config.d_ssim_halved == recipe.d_ssim_halved
    assert (config.lr, PROFILES[config.profile]) == (recipe.lr, recipe.profile)
    assert (config.max_steps, config.sh_interval) == (recipe.max_steps, recipe.sh_interval)


@pytest.mark.parametrize("name", ROWS)
def test_a_row_can_be_trained_from_the_command_line(name):
    assert_trains(arguments(["scene", *options_for(ROWS[name])])[0], ROWS[name])
    assert_trains(TrainConfig.from_options(options_for(ROWS[name])), ROWS[name])


def test_the_options_of_a_run_say_its_numbers_to_the_last_digit():
    asked = TrainConfig.of(steps_scaler=0.123456789, init_scale=2.0, **{"lr.means": 1.23456789e-4}).given
    words = ["--steps-scaler", "0.123456789", "--init-scale", "2", "--lr.means", "0.000123456789"]
    assert words_of(asked) == words
    assert arguments(["scene", *words])[0].given.settings == {"data": "scene", **asked.settings}
    assert TrainConfig.from_options([*words, "--preset", "quick"]).given == replace(asked, preset="quick")


def test_a_method_may_be_any_object_that_has_what_one_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    own = type("Own", (GsplatStrategy,), {})
    plain = SimpleNamespace(**{**METHODS["gsplat"]._asdict(), "strategy": own})
    monkeypatch.setitem(METHODS._given, "mine", plain)
    asked = TrainConfig.of(method="mine")
    assert (asked.method, type(asked.strategy)) == ("mine", own)
    METHODS.look_again()


def test_rows_differ_and_their_options_are_few():
    named = {name: tuple(options_for(recipe)) for name, recipe in ROWS.items()}
    assert len(set(named.values())) == len(named)
    assert (named["POP"], named["gsplat"], named["3DGS"]) == ((), ("--method", "gsplat"), ("--method", "3dgs"))
    assert named["L2+Blur"] == ("--pop.lambda-pop", "0")


# What `pop train` chooses where no schedule is said, and photographs that come as a video or in an archive.

SPEED = Speed(few=10_000, many=40_000, seconds_few=0.02, seconds_many=0.05, took=5.0)
QUICKLY = ("--checkpoint-every", "50", "--skip-checks", "--skip-sizes", "--no-progress")


@pytest.mark.parametrize(
    ("side", "gpu", "minutes", "left"),
    [
        *((4032, True, MINUTES, 2016), (3000, True, MINUTES, 1500), (1920, True, 1.0, 1920)),
        *((4032, False, MINUTES, 1008), (1920, False, MINUTES, 960), (1920, False, 3.0, 480), (512, False, 1.0, 512)),
        *((640, False, 3.0, 640), (777, False, 3.0, 777), (778, False, 3.0, 389), (4032, False, 3.0, 576)),
    ],
)
def test_photographs_are_shrunk_to_what_the_machine_trains_on(side: int, gpu: bool, minutes: float, left: int) -> None:
    assert side // factor_for([(side, side // 2), (64, 48)], gpu, minutes) == left


def test_the_schedule_fills_the_minutes_and_is_at_most_the_papers() -> None:
    def chosen(minutes: float) -> Choice:
        return choose_length(TrainConfig.of(preset="auto"), SPEED, minutes, 1e5, 50, 7)

    choices = [chosen(minutes) for minutes in (3.0, 8.0, 15.0)]
    for minutes, choice in zip((3.0, 8.0, 15.0), choices, strict=True):
        assert 0.97 * 60.0 * minutes <= choice.seconds <= 60.0 * minutes * 1.005
    assert choices[0].scaler < choices[1].scaler < choices[2].scaler < 1.0
    assert chosen(1e4).scaler == 1.0
    # what does not fit is not said to
    assert chosen(0.01).scaler == SHORTEST
    assert chosen(0.01).seconds > 0.6
    # no minute more makes it shorter
    scalers = [chosen(minutes).scaler for minutes in np.linspace(0.2, 4.0, 60)]
    assert scalers == sorted(scalers)
    assert min(scalers) < QUICK_SCALER < max(scalers)


def test_few_photographs_are_not_looked_at_for_as_long_as_the_minutes_allow() -> None:
    config = TrainConfig.of(preset="auto")
    few = choose_length(config, SPEED, 1e4, 1e5, 11, 2)
    assert few.scaler == pytest.approx(LOOKS * 9 / 30_000, rel=1e-2)
    assert "each of 9 photographs is seen 200 times" in str(few.why)
    # four views a step are looked at four times as often
    batch = choose_length(replace(config, given=None, batch_size=4), SPEED, 1e4, 1e5, 11, 2)
    assert batch.scaler == pytest.approx(few.scaler / 4.0, rel=1e-2)
    # what the minutes cut shorter has that reason
    short = choose_length(config, SPEED, 0.5, 1e5, 11, 2)
    assert short.scaler < few.scaler
    assert short.why is None
    assert choose_length(config, SPEED, 1e4, 1e5, 34, 4).scaler == pytest.approx(LOOKS * 30 / 30_000)
    enough = choose_length(config, SPEED, 1e4, 1e5, 35, 4)
    assert (enough.scaler, enough.why) == (1.0, None)


@pytest.mark.parametrize("method", ["pop", "gsplat", "3dgs"])
def test_a_short_schedule_has_the_rates_and_the_coarse_photographs_of_quick(method: str) -> None:
    def auto(scaler: float, **said: Any) -> TrainConfig:
        return TrainConfig.of(method=method, preset="auto", steps_scaler=scaler, **said)

    quick, shorter = TrainConfig.of(method=method, preset="quick"), auto(SHORTEST)
    assert replace(auto(QUICK_SCALER), given=None) == replace(quick, given=None)
    assert auto(1.01 * QUICK_SCALER).coarse_stop_iters == ()
    assert shorter.lr == quick.lr
    assert [stop / shorter.max_steps for stop in shorter.coarse_stop_iters] == pytest.approx([1 / 6, 1 / 3], rel=0.01)
    said = auto(SHORTEST, **{"lr.sh0": 0.5, "coarse_stop_iters": ()})
    assert (said.lr.sh0, said.coarse_stop_iters) == (0.5, ())


@pytest.mark.parametrize("method", ["pop", "gsplat", "3dgs"])
def test_rates_go_from_those_of_quick_to_the_published_ones_and_no_length_jumps(method: str) -> None:
    scalers = np.geomspace(QUICK_SCALER, 1.0, 40)
    found = [TrainConfig.of(method=method, preset="auto", steps_scaler=float(by)).lr for by in scalers]
    quick, published = TrainConfig.of(method=method, preset="quick").lr, TrainConfig.of(method=method).lr
    assert (found[0], found[-1]) == (quick, published)
    for name in ("means", "scales", "quats", "sh0", "sh_rest"):
        rates = np.array([getattr(lr, name) for lr in found])
        assert (rates >= getattr(published, name)).all()
        # no rate falls faster than the schedule grows
        assert (rates[1:] <= rates[:-1]).all()
        assert (rates[1:] >= rates[:-1] * scalers[:-1] / scalers[1:] * (1.0 - 1e-9)).all()
        # all end where those of quick end or the published ones, or above
        least = min(getattr(quick, name) * quick.others_decay, getattr(published, name))
        assert (rates * [lr.others_decay for lr in found] >= 0.999 * least).all()
    assert {lr.opacities for lr in found} == {published.opacities}
    # second moments are remembered longer in longer schedules, and as usual from a quarter on
    decays = np.array([lr.beta2 for lr in found])
    assert (np.diff(decays) >= 0.0).all()
    assert np.diff(decays).max() < 0.1 * (decays[-1] - decays[0])
    assert ((decays == published.beta2) == (scalers >= QUICK_BETA2_UNTIL)).all()


def test_a_step_with_more_gaussians_takes_longer_by_as_much_as_was_measured() -> None:
    assert SPEED.seconds_a_step(10_000) == pytest.approx(0.02)
    assert SPEED.seconds_a_step(25_000) == pytest.approx(0.035)
    # a machine that was held up in the first measurement does not get faster with more
    assert Speed(10, 20, 0.5, 0.4).seconds_a_step(30) == 0.5
    last, mean = expected_gaussians("pop", 1_000, 1e4, 20, 0.1)
    assert 1_000 < mean < last


# method, Gaussians at the start, px of a photograph, photographs, scaler, Gaussians at the end: of benchmarks/results,
# paper_repro/results and runs of 11 photographs of a castle
ENDED = [
    *(("pop", 2_903, 129_600, 8, 0.05, 9_640), ("pop", 9_293, 129_600, 25, 0.05, 16_220)),
    *(("pop", 12_037, 129_600, 43, 0.1, 23_812), ("pop", 12_037, 129_600, 43, 1.0, 51_486)),
    *(("pop", 34_174, 262_144, 84, 0.05, 50_269), ("pop", 34_174, 262_144, 84, 0.1, 57_520)),
    *(("pop", 138_766, 262_144, 161, 0.05, 155_999), ("pop", 138_766, 262_144, 161, 0.1, 174_982)),
    *(("pop", 109_926, 106_400, 255, 0.05, 124_785), ("pop", 109_926, 106_400, 255, 0.1, 128_315)),
    ("pop", 8_381, 167_560, 9, 0.519, 40_437),
    *(("gsplat", 12_037, 129_600, 43, 0.1, 108_258), ("gsplat", 34_174, 262_144, 84, 0.1, 380_025)),
    *(("gsplat", 138_766, 262_144, 161, 0.1, 727_341), ("gsplat", 109_926, 106_400, 255, 0.1, 511_103)),
    ("3dgs", 12_037, 129_600, 43, 1.0, 197_012),
]


def test_gaussians_are_foretold_as_runs_had_them() -> None:
    for method, *run, ended in ENDED:
        within = 0.1 if method == "pop" else 0.15
        assert expected_gaussians(method, *run)[0] == pytest.approx(ended, rel=within), (method, run)


def test_a_run_chooses_where_no_schedule_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    # of torchrun's variables: one alone starts no other process
    monkeypatch.setenv("WORLD_SIZE", "2")
    for words in ("photos", "photos --minutes 3 --method gsplat"):
        assert chooses_for_itself(words.split())
    for words in ("--preset=paper", "--steps_scaler 0.1", "--max-steps 10", "--blocks 2x1"):
        assert not chooses_for_itself(["photos", *words.split()])
    for name in LAUNCHED:
        monkeypatch.setenv(name, "2")
    assert not chooses_for_itself(["photos"])


def test_a_run_without_options_says_what_it_chose_keeps_it_and_resumes_to_the_same_bits(
    pop, shared_capture, tmp_path, monkeypatch
):
    words = ("train", shared_capture, "--minutes", "0.001", *QUICKLY)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    outcome = pop(*words, "--out", whole)
    assert outcome.status == 0, outcome.err
    line = next(line for line in outcome.out.splitlines() if line.startswith("chosen for this"))
    for part in ("40x32 px", "300 steps", "Gaussians", "GB of memory", "--preset paper"):
        assert part in line
    given = json.loads((whole / "cfg.json").read_text())["given"]
    assert (given["preset"], given["steps_scaler"]) == ("auto", SHORTEST)
    with monkeypatch.context() as patch:
        interrupt(patch, at=120)
        assert pop(*words, "--out", broken).status == 130
    # a machine that is now a thousand times as fast goes on with the schedule that was begun
    monkeypatch.setattr(automatic, "measure_speed", lambda *given: pytest.fail("a resumed run is timed"))
    resumed = pop("train", shared_capture, *QUICKLY, "--out", broken, "--resume")
    assert resumed.status == 0, resumed.err
    ours, theirs = (ckpt.load_splats(ckpt.checkpoint_path(folder, 299))[0] for folder in (whole, broken))
    assert all((ours[name] == theirs[name]).all() for name in ours)


def test_what_is_said_wins_over_what_is_chosen(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    said = ("--factor", "2", "--pop.blur-min-pixels", "3", "--log-every", "50")
    pop.done("train", shared_capture, "--out", tmp_path / "r", "--minutes", "0.001", *said, *QUICKLY)
    resolved = json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]
    assert (resolved["factor"], resolved["log_every"], resolved["strategy"]["blur_min_pixels"]) == (2, 50, 3.0)


def with_tracks(root: Path, every: int) -> Path:
    """Let every photograph of a COLMAP capture see every so manieth point; none at 0."""
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    for number, point in enumerate(model.points3D.values()):
        images = model.images if every and number % every == 0 else ()
        point.track.elements = [pycolmap.TrackElement(image, 0) for image in images]
    model.write_binary(str(root / "sparse" / "0"))
    return root


def chosen(capture: Capture, stops: float | None = None, **said: Any) -> Terms:
    return choose_terms(capture, TrainConfig.of(preset="auto", **{"backend": "fast", **said}), stops)


def test_depth_is_held_to_sparse_points_where_photographs_are_few_and_say_which_they_see() -> None:
    few, many = tiny_capture(n_views=FEW), tiny_capture(n_views=2 * FEW)
    for capture in (few, tiny_capture()):
        terms, count = chosen(capture), len(capture.train_views())
        assert terms.settings == {"depth_lambda": next(weight for most, weight in DEPTH_LAMBDAS if count <= most)}
        assert f"{count} photographs are few, neighbours" in terms.why[0]
    assert chosen(tiny_capture()).settings["depth_lambda"] > chosen(few).settings["depth_lambda"] > 0.0
    assert chosen(many) == Terms()
    # it was not measured with other methods
    assert choose_terms(few, TrainConfig.of(preset="auto", method="gsplat", backend="fast"), None) == Terms()
    blind = replace(few, views=tuple(replace(view, seen=None) for view in few.views))
    assert chosen(blind).settings == {}
    assert "no tracks" in chosen(blind).why[0]
    assert chosen(few, depth_lambda=0.0) == chosen(blind, depth_lambda=0.0) == Terms()


def test_exposures_are_learned_where_cameras_noted_that_they_drift() -> None:
    capture = tiny_capture(n_views=2 * FEW)
    assert chosen(capture, 2.0).settings == {"exposure": True}
    assert "2.0 stops apart" in chosen(capture, 2.0).why[0]
    assert chosen(capture, 1.0) == chosen(capture, 2.0, exposure=False) == chosen(capture, 2.0, batch_size=2) == Terms()
    # a term that the backend does not know is not chosen, and that is said
    terms = chosen(tiny_capture(), 2.0, backend="cuda")
    assert terms.settings == {}
    assert ["depth_lambda" in why or "exposure" in why for why in terms.why] == [True, True]


def test_what_was_chosen_for_few_photographs_is_said_kept_reported_and_gone_on_with(
    pop, capture, tmp_path, monkeypatch
):
    words = ("train", with_tracks(capture, 4), "--minutes", "0.001", "--out", tmp_path / "r", *QUICKLY)
    with monkeypatch.context() as patch:
        interrupt(patch, at=120)
        outcome = pop(*words)
    assert outcome.status == 130
    weight = DEPTH_LAMBDAS[0][1]
    assert f"(--depth-lambda {weight:g}), because 7 photographs are few" in outcome.out
    assert "1 of 8 photographs is held out" in outcome.out
    assert "--test-every 0" in outcome.out
    assert pop(*words, "--resume").status == 0
    resolved = json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]
    assert resolved["depth_lambda"] == weight
    data = read_result(tmp_path / "r")
    assert "because 7 photographs are few" in data.config["chosen by the run"]
    # an explicit number of held-out views is not reported again
    said = pop(*words, "--overwrite", "--test-every", "4", "--depth-lambda", "0")
    assert "held out for measuring" not in said.out
    assert "--depth-lambda" not in said.out


def test_depth_that_no_track_tells_is_warned_of(pop: Pop, capture: Path, tmp_path: Path) -> None:
    words = ("--max-steps", "2", "--out", tmp_path / "r", "--depth-lambda", "0.01", *QUICKLY)
    said = pop.done("train", with_tracks(capture, 0), *words).err
    assert "depth_lambda is 0.01, but the term has no effect" in said


def test_minutes_and_a_schedule_exclude_each_other(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    words = ("train", shared_capture, "--out", tmp_path / "r", "--minutes")
    for schedule in (("--preset", "quick"), ("--max-steps", "9"), ("--steps-scaler", "0.1")):
        says(pop(*words, "5", *schedule), f"--minutes chooses the schedule, but {schedule[0]}", "leave one of them out")
    for schedule in (("--max-steps", "9"), ("--steps-scaler", "0.1")):
        said = f"--minutes chooses the schedule, but {schedule[0]} has another"
        says(pop(*words, "5", "--preset", "auto", *schedule), said)
    says(pop(*words, "5", "--blocks", "2x1"), "--minutes chooses the schedule, but --preset paper, --blocks or")
    says(pop(*words, "-1"), "--minutes is -1.0")


def test_an_archive_trains_without_a_second_command(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    packed = tmp_path / "toy.zip"
    with zipfile.ZipFile(packed, "w") as file:
        for part in filter(Path.is_file, shared_capture.rglob("*")):
            file.write(part, f"walk/{part.relative_to(shared_capture).as_posix()}")
        file.writestr("__MACOSX/._a.jpg", b"nothing")
        file.writestr("README.txt", b"beside the capture")
    said = pop.done("train", packed, "--out", tmp_path / "r", "--max-steps", "2", *QUICKLY).out
    assert "unpacked in" in said
    folder = tmp_path / "toy_unpacked" / "walk"
    assert json.loads((tmp_path / "r" / "cfg.json").read_text())["resolved"]["data"] == str(folder)
    assert not (tmp_path / "toy_unpacked" / "__MACOSX").exists()
    # a second time it is there, and another archive of that name has a folder of its own
    assert capture_folder(packed)[0] == folder
    other = Path(shutil.copy(packed, tmp_path / "toy.usdz"))
    assert capture_folder(other)[0] == tmp_path / "toy.usdz_unpacked" / "walk"
    # minutes would choose a schedule, and this run has one
    asked = pop("train", packed, "--out", tmp_path / "r", "--minutes", "1", "--resume")
    says(asked, f"the run in {tmp_path / 'r'} was begun with another; leave --minutes out")


def test_a_zip_of_macos_keeps_its_umlauts(tmp_path: Path) -> None:
    names = ("Tür/ä 1.jpg", "plain.jpg")
    for flag, name in itertools.product((True, False), names):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
            file.writestr(name, b"x")
        if not flag:  # macOS writes UTF-8, and does not say so: in the local header, and in the directory
            data = bytearray((tmp_path / "a.zip").read_bytes())
            for at in (6, data.index(b"PK\x01\x02") + 8):
                data[at + 1] &= ~0x08
            (tmp_path / "a.zip").write_bytes(data)
        unpack(tmp_path / "a.zip", tmp_path / f"{flag}_{name[0]}")
        assert (tmp_path / f"{flag}_{name[0]}" / name).is_file()


def test_an_archive_that_leads_out_of_its_folder_fills_the_disk_or_is_damaged_is_refused(tmp_path: Path) -> None:
    for name in ("../out.jpg", "/out.jpg", "a/../../out.jpg", "c:/out.jpg", "..\\out.jpg"):
        with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
            file.writestr("fine.jpg", b"1")
            file.writestr(name, b"2")
        with pytest.raises(CaptureError, match=r"^\S+a\.zip: '\S+' would be unpacked outside of its folder; [^;:]+$"):
            unpack(tmp_path / "a.zip", tmp_path / "deep" / "a")
        assert not list(tmp_path.rglob("*.jpg"))
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.jpg", bytes(300_000_000))
    with pytest.raises(CaptureError, match=r"bomb\.zip.*MB"):
        unpack(tmp_path / "bomb.zip", tmp_path / "a")
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as file:
        file.writestr("a.jpg", b"some bytes that are checked")
    damaged = bytearray((tmp_path / "c.zip").read_bytes())
    damaged[40] ^= 0xFF
    (tmp_path / "c.zip").write_bytes(damaged)
    with pytest.raises(CaptureError, match="cannot be unpacked"):
        unpack(tmp_path / "c.zip", tmp_path / "c")
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "c").exists()
    # a copy that was cut short has lost its end, by which archives are known
    (tmp_path / "d.zip").write_bytes(damaged[:50])
    with pytest.raises(CaptureError, match=r"d\.zip: cannot be unpacked"):
        capture_folder(tmp_path / "d.zip")
    assert not (tmp_path / "d_unpacked").exists()


def test_a_video_is_a_folder_of_its_frames_the_second_time_too(tmp_path: Path) -> None:
    film = tmp_path / "walk.webm"
    rng = np.random.default_rng(0)
    with VideoFile(film, 5.0) as video:
        for _ in range(6):
            # nothing alike, or it would be a camera at rest
            video.add(np.kron(rng.integers(0, 255, (6, 8, 3)), np.ones((16, 16, 1))).astype(np.uint8))
    folder, said = capture_folder(film)
    assert folder == tmp_path / "walk_frames"
    assert "of 6 frames" in said
    taken = sorted(folder.iterdir())
    assert len(taken) >= 2
    again, said = capture_folder(film)
    assert (again, sorted(again.iterdir())) == (folder, taken)
    assert "already" in said
    # another video of that name has frames of its own, and the first one its own, too
    shutil.copy(film, tmp_path / "walk.avi")
    assert [capture_folder(tmp_path / name)[0].name for name in ("walk.avi", "walk.webm")] == [
        "walk.avi_frames",
        "walk.webm_frames",
    ]
    (tmp_path / "walk.avi").unlink()
    os.utime(film, (folder.stat().st_mtime + 60.0,) * 2)
    with pytest.raises(CaptureError, match="is older than"):
        capture_folder(film)
