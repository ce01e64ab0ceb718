"""Gaussians that are held fixed keep their bits whatever takes the steps, and the others are trained among them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import pop_fast.compiled
from pop_fast.blocks.rounds import shown_in
from pop_fast.data.initialize import initialize_params
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.engines import engine_of
from pop_fast.train.fixed_rows import hold_last
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_fast.train.refining import at_rest, refining
from pop_fast.train.schedule import phase_at, updates_of
from tests.app.interruptions import interrupt
from tests.app.tiny import N_POINTS, tiny_capture, tiny_config

STEPS, OWN = 12, 25
compiled = pytest.mark.skipif(pop_fast.compiled.why_not() is not None, reason="the CPU kernels are not compiled")
ENGINES = ["fast", pytest.param("compiled", marks=compiled)]


def settings(folder: Path, backend: str, **changes: Any) -> TrainConfig:
    return replace(refining(tiny_config(folder, backend=backend), STEPS), **changes)


def first_rows() -> dict[str, Tensor]:
    return initialize_params(tiny_capture(), seed=3, init_opacity=0.5, init_scale=0.5)


def trained(config: TrainConfig, initial: dict[str, Tensor], own: int, **how: Any) -> dict[str, Tensor]:
    fixed = {key: value[own:].clone() for key, value in initial.items()}
    given = {key: value.clone() for key, value in initial.items()}
    run = TrainingRun(config, tiny_capture(), initial=given, engine=hold_last(engine_of(config), fixed), **how)
    stats = run.run()
    assert stats["fixed_gaussians"] == len(initial["means"]) - own
    return {key: value.detach() for key, value in run.params.items()}


@pytest.mark.parametrize("backend", ENGINES)
def test_fixed_rows_keep_their_bits_and_the_others_move(tmp_path, backend):
    initial = first_rows()
    found = trained(settings(tmp_path, backend), initial, OWN)
    for key in KEYS:
        assert torch.equal(found[key][OWN:], initial[key][OWN:])
        # every number of a Gaussian that a view shows has a gradient
        assert (found[key][:OWN] != initial[key][:OWN]).any(dim=tuple(range(1, found[key].dim()))).sum() > 0.9 * OWN


@pytest.mark.parametrize("backend", ENGINES)
def test_every_step_draws_the_fixed_rows_as_they_were_given(tmp_path, backend):
    # with all but one Gaussian fixed, and that one out of sight, every step of a view measures the same
    initial = first_rows()
    initial["means"][0] = torch.tensor([0.0, 500.0, 0.0])
    config = settings(tmp_path, backend, log_every=1)
    fixed = {key: value[1:].clone() for key, value in initial.items()}
    run = TrainingRun(config, tiny_capture(), initial=initial, engine=hold_last(engine_of(config), fixed))
    losses: dict[str, set[float]] = {}
    while run.step < STEPS:
        segment = run.take_steps(run.step + 1)
        losses.setdefault(segment.views[0], set()).add(segment.stats[0].objective)
    assert len(losses) == 4
    assert all(len(values) == 1 for values in losses.values())


@pytest.mark.parametrize("backend", ENGINES)
def test_an_interrupted_training_goes_on_to_the_same_bits(tmp_path, backend, monkeypatch):
    initial = first_rows()
    whole = trained(settings(tmp_path / "whole", backend), initial, OWN)
    config = settings(tmp_path / "stopped", backend)
    with monkeypatch.context() as patch:
        interrupt(patch, at=7)
        with pytest.raises(KeyboardInterrupt):
            trained(config, initial, OWN)
    gone_on = trained(config, initial, OWN, resume=True)
    assert all(torch.equal(gone_on[key], whole[key]) for key in KEYS)


def test_a_checkpoint_with_other_fixed_rows_is_refused(tmp_path, monkeypatch):
    initial, config = first_rows(), settings(tmp_path, "fast")
    with monkeypatch.context() as patch:
        interrupt(patch, at=7)
        with pytest.raises(KeyboardInterrupt):
            trained(config, initial, OWN)
    initial["opacities"][-1] += 1.0
    with pytest.raises(PopError, match="opacities of the Gaussians that are held fixed are others"):
        trained(config, initial, OWN, resume=True)


@pytest.mark.parametrize("backend", ENGINES)
def test_what_no_view_shows_can_be_left_out_without_a_change_of_bits(tmp_path, backend):
    initial, capture = first_rows(), tiny_capture()
    # behind a ring of cameras that all look inwards, and far to the side
    initial["means"][40:50] = torch.tensor([0.0, 300.0, 0.0]) + torch.arange(10.0)[:, None]
    config = settings(tmp_path / "all", backend)
    shown = shown_in(capture.views, initial, config)
    assert shown[:40].all()
    assert not shown[40:50].any()
    less = {key: value[shown] for key, value in initial.items()}
    every = trained(config, initial, OWN)
    part = trained(replace(config, result_dir=str(tmp_path / "part")), less, OWN)
    assert all(torch.equal(every[key][:OWN], part[key][:OWN]) for key in KEYS)


def test_what_is_shown_is_found_in_pieces_as_at_once(monkeypatch):
    initial, capture = first_rows(), tiny_capture()
    initial["means"] *= 4.0
    config = tiny_config("nowhere")
    at_once = shown_in(capture.views[:2], initial, config)
    assert 0 < at_once.sum() < N_POINTS
    monkeypatch.setattr("pop_fast.blocks.rounds._AT_A_TIME", 7)
    assert torch.equal(shown_in(capture.views[:2], initial, config), at_once)


@pytest.mark.parametrize("method", METHODS)
def test_density_control_of_every_method_can_rest(method):
    config = TrainConfig.of(method=method, preset="quick")
    resting = at_rest(config.strategy)
    steps = range(config.max_steps)
    assert any(config.strategy.changes_after(step) for step in steps)
    assert not any(resting.changes_after(step) or resting.needs_passes(step) for step in steps)
    assert not set(resting.adam_restarts) & set(steps)
    assert type(resting) is type(config.strategy)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scaler", [1.0, 0.002])
def test_a_training_goes_on_as_another_has_ended(method, scaler):
    before = TrainConfig.of(method=method, steps_scaler=scaler, l2_stop_iter=1 if method == "pop" else None)
    after = refining(before, 40)
    last = before.max_steps - 1
    ended = phase_at(before, before.strategy, last)
    assert all(phase_at(after, after.strategy, step) == ended for step in range(40))
    rates = updates_of(after.lr, 1.0, 40, after.strategy).rates[:, 0].numpy()
    final = before.lr.means * before.lr.means_decay
    np.testing.assert_allclose(rates, 10.0 * final * 0.1 ** (np.arange(40) / 40), rtol=1e-12)
