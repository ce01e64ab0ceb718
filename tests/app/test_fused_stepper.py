"""A run whose engine takes many steps at a time: segments, statistics, densification steps, checkpoints, errors."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from cuda_ext.arrays import CudaMemoryError
from pop_fast.cuda.backend import CUDA
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.fused_stepper import step_settings
from pop_fast.train.schedule import phase_at, segment_end, updates_of
from pop_fast.train.whole_step import why_not_trained
from pop_ref.settings import PARAMETERS
from tests.app.drift import MOST, Drift, drift_engine
from tests.app.tiny import HEIGHT, WIDTH, last_checkpoint, tiny_capture, tiny_config

CLOCKS = ("it_per_s", "seconds")


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


def everything(folder):
    """All of a finished run's last checkpoint that does not depend on the backend or a clock, flat."""
    return last_checkpoint(folder, "seconds", "metrics_bytes", "config")


def assert_same_state(ours, theirs):
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == theirs[name].dtype, name
            assert torch.equal(value, theirs[name]), name
        else:
            assert value == theirs[name], name


def records(folder):
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def drifting(folder, resume=False, **changes):
    return TrainingRun(tiny_config(folder, **changes), tiny_capture(), engine=drift_engine(), resume=resume)


@pytest.mark.parametrize("case", CASES)
def test_stopping_anywhere_and_going_on_changes_nothing(case, tmp_path):
    changes = CASES[case]
    drifting(tmp_path / "whole", **changes).run()
    for place, stop_after in enumerate((3, 11, 13, 17, 29)):
        trainer = drifting(tmp_path / "parts", **changes, resume=place > 0)
        # leave at once, without any clean-up, somewhere in a segment
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Drift, "before_step", lambda self, step, stop=stop_after: interrupt(step, stop))
            with pytest.raises(KeyboardInterrupt):
                trainer.run()
    drifting(tmp_path / "parts", **changes, resume=True).run()
    assert_same_state(everything(tmp_path / "parts"), everything(tmp_path / "whole"))
    ours, theirs = ([{k: v for k, v in r.items() if k not in CLOCKS} for r in records(tmp_path / name)]
                    for name in ("parts", "whole"))  # fmt: skip
    assert ours == theirs


def interrupt(step, stop):
    if step == stop:
        raise KeyboardInterrupt


def test_a_polite_stop_ends_with_the_segment_and_writes_a_checkpoint(tmp_path, monkeypatch):
    import os
    import signal

    monkeypatch.setattr(
        Drift, "before_step", lambda self, step: os.kill(os.getpid(), signal.SIGINT) if step == 6 else None
    )
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
