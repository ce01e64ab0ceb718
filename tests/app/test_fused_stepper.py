"""A run whose engine takes many steps at a time: segments, statistics, densification steps, checkpoints, errors."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import pop_fast.compiled
from cuda_ext.arrays import CudaMemoryError
from pop_fast.api.backend import get_backend
from pop_fast.api.backends import CUDA
from pop_fast.blocks.rounds import hold_last, shown_in
from pop_fast.data.gaussians import initialize_params
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.engines import engine_of, torch_engine
from pop_fast.train.model import KEYS
from pop_fast.train.presets import METHODS
from pop_fast.train.schedule import phase_at, refining, segment_end, updates_of, updates_of_strategy
from pop_fast.train.stepper import Engine, FusedStepper, step_settings
from pop_fast.train.steps import Collected, Phase, StepSettings, StepStats, why_not_trained
from pop_fast.train.torch_stepper import BatchStepper
from pop_fast.train.views import ViewTensors
from pop_ref.settings import PARAMETERS
from tests.app.tiny import (
    HEIGHT,
    N_POINTS,
    WIDTH,
    assert_same_run,
    interrupted,
    records,
    run_until,
    tiny_capture,
    tiny_config,
)

# steps at a time, as on a GPU
MOST = 500
Rows = Mapping[str, Tensor]


class Drift:
    """Take whole steps without being a training step: numbers drift, deterministically, by what they are.

    The interface is that of `cuda_ext.training.train_step.FusedTrainer`, on the CPU; it shows what the run does around
    such steps. What real steps compute is shown by real steppers. Tests may set `before_step`, called with the step's
    number.
    """

    def __init__(
        self,
        params: Rows,
        m: Rows,
        v: Rows,
        views: Sequence[ViewTensors],
        order: Sequence[int],
        settings: StepSettings,
        step: int,
    ) -> None:
        assert len(order) == len(settings.updates.rates)
        self.views, self.order, self.settings, self.step = views, order, settings, step
        self.grown = 0
        self.runs: list[tuple[int, int, Phase]] = []
        self._stats: dict[int, StepStats] = {}
        self.rebind(params, m, v)

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        self.params, self.m, self.v = dict(params), dict(m), dict(v)
        self.statistics = Collected.zeros(len(params["means"]), params["means"].device)

    def run(self, until: int, phase: Phase) -> None:
        self.runs.append((self.step, until, phase))
        while self.step < until:
            self.before_step(self.step)
            for rows in self.params.values():
                if not bool(torch.isfinite(rows).all()):
                    raise ValueError(f"step {self.step}: a Gaussian has a value that is not finite")
            self._stats[self.step] = self._one(self.order[self.step], phase)
            self.step += 1

    def step_stats(self, first: int, last: int) -> list[StepStats]:
        return [self._stats[step] for step in range(first, last)]

    def synchronize(self) -> None:
        """Nothing: there is one process."""

    def facts(self) -> dict[str, int]:
        return {"instance_buffers_grown": self.grown}

    def before_step(self, step: int) -> None:
        """Nothing; for tests."""

    def _one(self, view: int, phase: Phase) -> StepStats:
        rates = dict(zip(PARAMETERS, self.settings.updates.rates[self.step].tolist(), strict=True))
        found, shift = self.statistics, torch.cos(self.params["means"].sum(1) + view)
        for name, rows in self.params.items():
            step = shift.reshape(-1, *[1] * (rows.dim() - 1))
            self.m[name].mul_(0.9).add_(0.1 * step)
            self.v[name].mul_(0.9).add_(0.1 * step * step)
            rows.add_(rates[name] * self.m[name] / (self.v[name].sqrt() + 1.0))
        if phase.statistics:
            found.grad_sum.add_(0.02 * shift.abs())
            found.n_visible.add_((shift > -0.5).int())
        counts = (20.0 * shift.clamp_min(0.0)).int()
        if phase.blur or phase.window:
            found.dominant_sum.add_(counts)
        if phase.blur:
            blurred = counts > self.settings.blur_pixels(self.views[view].kept_pixels)
            found.blurred.copy_(blurred if self.settings.blur_window == "own_view" else found.blurred.bool() | blurred)
        loss = float(shift.square().mean())
        return StepStats(loss, 0.5, loss, loss, 0.25 if phase.pop else 0.0)


def drift_engine() -> Engine:
    facts = {"gpu": "drift", "gpu_memory_bytes": 0}
    return Engine(
        "cuda",
        torch.device("cpu"),
        get_backend("fast"),
        lambda task: FusedStepper(task, "cuda", MOST, Drift),
        lambda: facts,
    )


def with_pop(**changes):
    return {"strategy": replace(tiny_config("x").strategy, **changes)}


def with_gsplat(**changes):
    strategy = tiny_config("x", method="gsplat").strategy
    return {"method": "gsplat", "strategy": replace(strategy, **changes)}


CASES = {
    "pop": {},
    "gsplat": {"method": "gsplat"},
    "summed": with_pop(blur_window="sum", blur_min_pixels=40.0),
    "window": with_pop(pop_views="window", lambda_pop=0.05),
    "any view": with_pop(blur_window="any_view"),
    "phases": with_pop(pop_start_iter=5, pop_stop_iter=13, blur_stop_iter=9, refine_stop_iter=18),
    "reset": with_gsplat(reset_every=7),
}


def drifting(folder, resume=False, **changes):
    return TrainingRun(tiny_config(folder, **changes), tiny_capture(), engine=drift_engine(), resume=resume)


@pytest.mark.parametrize("case", CASES)
def test_stopping_anywhere_and_going_on_changes_nothing(case, tmp_path, monkeypatch):
    changes, stop_after = CASES[case], None

    def before_step(self, step):
        # leave at once, without any clean-up, somewhere in a segment
        if step == stop_after:
            raise KeyboardInterrupt

    monkeypatch.setattr(Drift, "before_step", before_step)
    drifting(tmp_path / "whole", **changes).run()
    for place, after in enumerate((3, 11, 13, 17, 29)):
        stop_after = after
        with pytest.raises(KeyboardInterrupt):
            drifting(tmp_path / "parts", **changes, resume=place > 0).run()
    stop_after = None
    drifting(tmp_path / "parts", **changes, resume=True).run()
    assert_same_run(tmp_path / "parts", tmp_path / "whole", "config")


def test_a_polite_stop_ends_with_the_segment_and_writes_a_checkpoint(tmp_path, monkeypatch):
    def stops(self, step):
        if step == 6:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Drift, "before_step", stops)
    trainer = drifting(tmp_path, checkpoint_every=0, save_steps=())
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert trainer.step == 9
    assert [number for number, _ in ckpt.list_checkpoints(tmp_path)] == [8]


def test_the_device_is_left_alone_between_densification_steps(tmp_path):
    trainer = drifting(tmp_path, checkpoint_every=0, sh_interval=100)
    trainer.run()
    runs = trainer.stepper.fused.runs
    assert [(first, end) for first, end, _ in runs] == [
        *((0, 1), (1, 5), (5, 9), (9, 12), (12, 13), (13, 16), (16, 17), (17, 21), (21, 24), (24, 30))
    ]
    assert [phase.blur for _, _, phase in runs] == [True] * 7 + [False] * 3
    assert [phase.statistics for _, _, phase in runs] == [phase.pop for _, _, phase in runs] == [True] * 9 + [False]


def test_a_segment_ends_where_something_is_due():
    config = tiny_config("x", max_steps=9000, checkpoint_every=1000, strategy=POPStrategy())
    strategy, first = config.strategy, 0
    while first < config.max_steps:
        end = segment_end(config, strategy, first, MOST)
        assert first < end <= min(first + MOST, config.max_steps)
        assert len({phase_at(config, strategy, step) for step in range(first, end)}) == 1
        assert not any(strategy.changes_after(step) for step in range(first, end - 1))
        assert not any(taken % 1000 == 0 or taken == 12 for taken in range(first + 1, end))
        first = end


def test_statistics_say_where_and_how_often_buffers_grew(tmp_path, monkeypatch):
    def grows(self, step):
        self.grown += step in (3, 20)

    monkeypatch.setattr(Drift, "before_step", grows)
    stats = drifting(tmp_path).run()
    assert (stats["gpu"], stats["gpu_memory_bytes"], stats["instance_buffers_grown"]) == ("drift", 0, 2)
    assert stats["seconds_total"] >= stats["seconds"] > 0.0 < stats["seconds_loading"]


@pytest.mark.parametrize("key", ["means", "opacities", "shN"])
def test_a_number_that_is_not_finite_is_named_and_the_last_checkpoint_kept(key, tmp_path, monkeypatch):
    def poisons(self, step):
        if step == 7:
            self.params[key][5] = float("nan")

    monkeypatch.setattr(Drift, "before_step", poisons)
    with pytest.raises(PopError, match=rf"{key}\[5.*\] is nan after 7 steps"):
        drifting(tmp_path).run()
    assert [path.name for path in (tmp_path / "ckpts").iterdir()] == ["ckpt_4_rank0.pt"]


@pytest.mark.parametrize(
    "error", [CudaMemoryError("no room for tile lists: 9 MB asked for"), torch.cuda.OutOfMemoryError("CUDA. Tried")]
)
def test_a_full_gpu_says_what_to_lower(error, tmp_path, monkeypatch):
    def fails(self, step):
        raise error

    monkeypatch.setattr(Drift, "before_step", fails)
    with pytest.raises(PopError, match=r"no room.*; use smaller images \(--factor 2 or more\)"):
        drifting(tmp_path).run()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (with_pop(absgrad=True), "pop.absgrad = False only, not True"),
        (with_gsplat(refine_scale2d_stop_iter=9), "gsplat.refine_scale2d_stop_iter = 0 only"),
        (with_gsplat(absgrad=True), "gsplat.absgrad = False only, not True"),
    ],
)
def test_settings_that_the_device_does_not_know_are_refused_before_anything_starts(
    changes, words, tmp_path, monkeypatch
):
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    with pytest.raises(PopError, match="use --backend fast") as error:
        TrainingRun(tiny_config(tmp_path / "new", backend="cuda", **changes), tiny_capture())
    assert words in str(error.value)
    assert not (tmp_path / "new").exists()
    assert why_not_trained(CUDA, tiny_config("x")) is None


def test_the_fused_step_gets_the_learning_rates_in_its_own_words():
    config = tiny_config("x")
    settings = step_settings(config, updates_of(config.lr, 2.0, config.max_steps))
    first = dict(zip(PARAMETERS, settings.updates.rates[0].tolist(), strict=True))
    assert first == {**config.lr.by_parameter(), "means": 2.0 * config.lr.means}
    assert settings.blur_pixels(WIDTH * HEIGHT) == int(0.02 * WIDTH * HEIGHT)
    assert replace(settings, blur_min_pixels=40.0).blur_pixels(WIDTH * HEIGHT) == 40.0


# Gaussians that are held fixed keep their bits whatever takes the steps, and the others are trained among them.

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
        assert (found[key][:OWN] != initial[key][:OWN]).reshape(OWN, -1).any(1).sum() > 0.9 * OWN


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
def test_an_interrupted_training_goes_on_to_the_same_bits_and_not_with_other_fixed_rows(tmp_path, backend):
    initial = first_rows()
    whole = trained(settings(tmp_path / "whole", backend), initial, OWN)
    config = settings(tmp_path / "stopped", backend)
    with interrupted(at=7):
        trained(config, initial, OWN)
    others = {**initial, "opacities": initial["opacities"] + torch.eye(len(initial["opacities"]))[-1]}
    with pytest.raises(PopError, match="opacities of the Gaussians that are held fixed are others"):
        trained(config, others, OWN, resume=True)
    gone_on = trained(config, initial, OWN, resume=True)
    assert all(torch.equal(gone_on[key], whole[key]) for key in KEYS)


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
    resting = config.strategy.at_rest()
    steps = range(config.max_steps)
    assert any(config.strategy.changes_after(step) for step in steps)
    assert not any(resting.changes_after(step) or resting.needs_passes(step) for step in steps)
    assert not set(resting.adam_restarts) & set(steps)
    assert type(resting) is type(config.strategy)


def test_a_method_that_does_not_rest_is_refused_before_it_edits_a_finished_splat():
    class Restless(POPStrategy):
        def changes_after(self, step):
            return step % 7 == 6

    with pytest.raises(PopError, match=r"Restless would edit the Gaussians 7 steps after .* give it a method at_rest"):
        refining(replace(tiny_config("nowhere"), strategy=Restless()), STEPS)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scaler", [1.0, 0.002])
def test_a_training_goes_on_as_another_has_ended(method, scaler):
    before = TrainConfig.of(method=method, steps_scaler=scaler, l2_stop_iter=1 if method == "pop" else None)
    after = refining(before, 40)
    last = before.max_steps - 1
    ended = phase_at(before, before.strategy, last)
    assert all(phase_at(after, after.strategy, step) == ended for step in range(40))
    rates = updates_of(after.lr, 1.0, 40, after.strategy).rates.numpy()
    # also where the last steps are rounds with rates of their own, or positions have gone back on their curve
    was = updates_of_strategy(before, before.strategy, 1.0).rates[last].numpy()
    np.testing.assert_allclose(rates[:, 1:], np.tile(was[1:], (40, 1)), rtol=1e-12)
    step = 1.0 if method == "pup" else before.lr.means_decay ** (1.0 / before.max_steps)
    np.testing.assert_allclose(rates[:, 0], 10.0 * was[0] * step * 0.1 ** (np.arange(40) / 40), rtol=1e-12)


# A step of several views; what it is the laws of training say.


def test_a_run_of_batches_draws_as_many_views_a_step_and_continues_to_the_same_bits(tmp_path: Path) -> None:
    def run(folder: str, batch_size: int = 3, **how: Any) -> TrainingRun:
        return TrainingRun(tiny_config(tmp_path / folder, batch_size=batch_size), tiny_capture(), **how)

    run("whole").run()
    found = records(tmp_path / "whole")
    assert all(len(record["view"].split(", ")) == 3 for record in found)
    assert any(record.get("cloned", 0) + record.get("split", 0) > 0 for record in found)
    run_until(run("parts"), 17)
    run("parts", resume=True).run()
    assert_same_run(tmp_path / "parts", tmp_path / "whole")
    with pytest.raises(PopError, match="batch_size = 3, but this run has batch_size = 2"):
        run("parts", 2, resume=True).run()
    # checkpoints of one view a step say nothing of batches
    assert "batch_size" not in tiny_config("x").binding()
    assert tiny_config("x", batch_size=2).binding()["batch_size"] == 2


def test_a_loss_that_is_not_finite_names_the_view(tmp_path: Path) -> None:
    run = TrainingRun(tiny_config(tmp_path, batch_size=2), tiny_capture())
    assert isinstance(run.stepper, BatchStepper)
    with torch.no_grad():
        run.params["sh0"][0, 0, 0] = math.nan
    with pytest.raises(PopError, match=r"sh0\[0, 0, 0\] is nan after 0 steps; nothing was written"):
        run.run()
    assert not list(tmp_path.iterdir())


@compiled
def test_the_step_in_cpp_leaves_batches_to_autograd() -> None:
    for size, kind in ((1, FusedStepper), (2, BatchStepper)):
        engine = engine_of(tiny_config("x", backend="compiled", batch_size=size))
        run = TrainingRun(tiny_config("x", batch_size=size), tiny_capture(), engine=engine)
        assert isinstance(run.stepper, kind)


def test_the_fused_step_on_a_gpu_trains_batches_and_refuses_terms_that_it_does_not_know() -> None:
    assert why_not_trained(CUDA, tiny_config("x", batch_size=2)) is None
    for setting, option in (("exposure", True), ("depth_lambda", 0.1)):
        reason = why_not_trained(CUDA, tiny_config("x", **{setting: option}))
        assert f"trains with{'out' if option is True else ''} {setting}" in reason, reason
        assert "use --backend fast" in reason


def test_a_strategy_of_somebody_else_takes_one_view_a_step() -> None:
    with pytest.raises(PopError, match="batch_size is 2; it must be 1 with a third-party strategy"):
        TrainingRun(tiny_config("x", batch_size=2), tiny_capture(), strategy=POPStrategy(), engine=torch_engine("fast"))
    with pytest.raises(PopError, match="batch_size is 0; it must be at least 1"):
        tiny_config("x", batch_size=0)
