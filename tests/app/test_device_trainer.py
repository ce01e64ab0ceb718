"""Training that lets a device take many steps at a time is the CPU trainer's run, by a stand-in for the device."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from cuda_ext.arrays import CudaMemoryError
from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from pop_fast.strategies import POPStrategy
from pop_fast.train import Trainer
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.device_plan import LONGEST, changes_after, phase_at, step_settings, stretch_end, unsupported
from pop_fast.train.device_trainer import DeviceTrainer
from tests.app.stand_in import StandIn, stand_in_hardware
from tests.app.tiny import HEIGHT, WIDTH, tiny_capture, tiny_config

CLOCKS = ("it_per_s", "seconds")
# in the records of the CPU alone
MEASURED = ("n_blended", "n_traversed")


def with_pop(**changes):
    return {"strategy": replace(tiny_config("x").strategy, **changes)}


def with_gsplat(**changes):
    strategy = tiny_config("x", method="gsplat").strategy
    return {"method": "gsplat", "strategy": replace(strategy, **changes)}


def half_masked() -> Capture:
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[:, WIDTH // 2 :] = False
    capture = tiny_capture(mask=mask)
    first = dataclasses.replace(capture.views[1], mask=None)
    return dataclasses.replace(capture, views=(capture.views[0], first, *capture.views[2:]))


def mixed_sizes() -> Capture:
    capture = tiny_capture()
    small = dataclasses.replace(capture.views[2], image=np.ascontiguousarray(capture.views[2].image[:-5, :-3]))
    return dataclasses.replace(capture, views=(*capture.views[:2], small, *capture.views[3:]))


CASES = {
    "pop": ({}, tiny_capture),
    "gsplat": ({"method": "gsplat"}, tiny_capture),
    "masks": ({}, half_masked),
    "sizes": ({}, mixed_sizes),
    "background": ({"background": (0.25, 0.5, 1.0), "antialiased": True}, tiny_capture),
    "losses": (
        {"l2_stop_iter": 9, "d_ssim_halved": True, "photometric_divisor": 2.0, "ssim_padding": "same"},
        tiny_capture,
    ),
    "summed": (with_pop(blur_window="sum", blur_min_pixels=40.0), tiny_capture),
    "window": (with_pop(pop_views="window", lambda_pop=0.05), tiny_capture),
    "window after growth": (with_pop(pop_views="window", refine_stop_iter=18, blur_stop_iter=9), half_masked),
    "visible": (with_pop(pop_over="visible", lambda_pop=0.05), tiny_capture),
    "own view": (with_pop(blur_window="own_view"), tiny_capture),
    "phases": (with_pop(pop_start_iter=5, pop_stop_iter=13, blur_stop_iter=9, refine_stop_iter=18), tiny_capture),
    "reset": (with_gsplat(reset_every=7), tiny_capture),
}


def everything(folder):
    """All of a finished run's last checkpoint that does not depend on the backend or a clock, flat."""
    content, flat = ckpt.load_checkpoint(ckpt.checkpoint_path(folder, 29)), {}

    def walk(value, name):
        if isinstance(value, dict):
            for key, item in value.items():
                walk(item, f"{name}.{key}")
        else:
            flat[name] = value

    walk({k: v for k, v in content.items() if k not in ("seconds", "metrics_bytes", "config")}, "")
    return flat


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


def on_device(folder, make=tiny_capture, resume=False, hardware=None, **changes):
    hardware = hardware or stand_in_hardware()
    return DeviceTrainer(tiny_config(folder, **changes), make(), hardware=hardware, resume=resume)


@pytest.mark.parametrize("case", CASES)
def test_a_run_on_a_device_is_the_cpus_run(case, tmp_path):
    changes, make = CASES[case]
    expected = Trainer(tiny_config(tmp_path / "cpu", **changes), make()).run()
    found = on_device(tmp_path / "device", make, **changes).run()
    assert_same_state(everything(tmp_path / "device"), everything(tmp_path / "cpu"))
    for key in ("psnr", "ssim", "num_GS", "n_blended", "step", "opacity_above_0.9"):
        assert found[key] == expected[key], key
    assert found["backend"] == "fast"  # the stand-in's; on a GPU it is "cuda"
    ours, theirs = records(tmp_path / "device"), records(tmp_path / "cpu")
    assert len(ours) == len(theirs)
    for mine, other in zip(ours, theirs, strict=True):
        wanted = {key: value for key, value in other.items() if key not in (*CLOCKS, *MEASURED)}
        assert {key for key in mine if key not in CLOCKS} == set(wanted)
        assert mine["view"] == wanted.pop("view")
        assert {key: mine[key] for key in wanted} == pytest.approx(wanted, rel=1e-5)


@pytest.mark.parametrize("method", ["pop", "gsplat"])
def test_stopping_anywhere_and_going_on_changes_nothing(method, tmp_path):
    on_device(tmp_path / "whole", method=method).run()
    for place, stop_after in enumerate((3, 11, 13, 17, 29)):
        trainer = on_device(tmp_path / "parts", method=method, resume=place > 0)
        # leave at once, without any clean-up, somewhere in a stretch
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(StandIn, "before_step", lambda self, step, stop=stop_after: interrupt(step, stop))
            with pytest.raises(KeyboardInterrupt):
                trainer.run()
    on_device(tmp_path / "parts", method=method, resume=True).run()
    assert_same_state(everything(tmp_path / "parts"), everything(tmp_path / "whole"))
    ours, theirs = ([{k: v for k, v in r.items() if k not in CLOCKS} for r in records(tmp_path / name)]
                    for name in ("parts", "whole"))  # fmt: skip
    assert ours == theirs


def interrupt(step, stop):
    if step == stop:
        raise KeyboardInterrupt


def test_a_polite_stop_ends_with_the_stretch_and_writes_a_checkpoint(tmp_path, monkeypatch):
    import os
    import signal

    monkeypatch.setattr(
        StandIn, "before_step", lambda self, step: os.kill(os.getpid(), signal.SIGINT) if step == 6 else None
    )
    trainer = on_device(tmp_path, checkpoint_every=0, save_steps=())
    with pytest.raises(KeyboardInterrupt):
        trainer.run()
    assert trainer.step == 9
    assert [number for number, _ in ckpt.list_checkpoints(tmp_path)] == [8]


def test_the_device_is_left_alone_between_events(tmp_path):
    trainer = on_device(tmp_path, checkpoint_every=0, sh_interval=100)
    trainer.run()
    runs = trainer._stepper.runs
    assert [(first, end) for first, end, _ in runs] == [
        *((0, 5), (5, 9), (9, 12), (12, 13), (13, 16), (16, 17), (17, 21), (21, 24), (24, 30))
    ]
    assert [phase.blur for _, _, phase in runs] == [True] * 6 + [False] * 3
    assert [phase.statistics for _, _, phase in runs] == [phase.pop for _, _, phase in runs] == [True] * 8 + [False]


def test_a_stretch_ends_where_something_is_due():
    config = tiny_config("x", max_steps=9000, checkpoint_every=1000, strategy=POPStrategy())
    first = 0
    while first < config.max_steps:
        end = stretch_end(config, first)
        assert first < end <= min(first + LONGEST, config.max_steps)
        assert len({phase_at(config, step) for step in range(first, end)}) == 1
        assert not any(changes_after(config, step) for step in range(first, end - 1))
        assert not any(taken % 1000 == 0 or taken == 12 for taken in range(first + 1, end))
        first = end


def test_statistics_say_where_and_how_often_buffers_grew(tmp_path, monkeypatch):
    def grows(self, step):
        self.grown += step in (3, 20)

    monkeypatch.setattr(StandIn, "before_step", grows)
    stats = on_device(tmp_path).run()
    assert (stats["gpu"], stats["gpu_memory_bytes"], stats["instance_buffers_grown"]) == ("stand-in", 0, 2)
    assert stats["seconds_total"] >= stats["seconds"] > 0.0 < stats["seconds_loading"]


@pytest.mark.parametrize("key", ["means", "opacities", "shN"])
def test_a_number_that_is_not_finite_is_named_and_the_last_checkpoint_kept(key, tmp_path, monkeypatch):
    def poisons(self, step):
        if step == 7:
            self.params[key][5] = float("nan")

    monkeypatch.setattr(StandIn, "before_step", poisons)
    with pytest.raises(PopError, match=rf"{key}\[5.*\] is nan after 7 steps"):
        on_device(tmp_path).run()
    assert [path.name for path in (tmp_path / "ckpts").iterdir()] == ["ckpt_4_rank0.pt"]


@pytest.mark.parametrize(
    "error", [CudaMemoryError("no room for tile lists: 9 MiB asked for"), torch.cuda.OutOfMemoryError("CUDA. Tried")]
)
def test_a_full_gpu_says_what_to_lower(error, tmp_path, monkeypatch):
    def fails(self, step):
        raise error

    monkeypatch.setattr(StandIn, "before_step", fails)
    with pytest.raises(PopError, match=r"no room.*; use smaller images \(--factor 2 or more\)"):
        on_device(tmp_path).run()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (with_pop(absgrad=True), "pop.absgrad = False only, not True"),
        (with_gsplat(refine_scale2d_stop_iter=9), "gsplat.refine_scale2d_stop_iter = 0 only"),
        (with_gsplat(absgrad=True), "gsplat.absgrad = False only, not True"),
    ],
)
def test_settings_that_the_device_does_not_know_are_refused_before_anything_starts(changes, words, tmp_path):
    with pytest.raises(PopError, match="use --backend fast") as error:
        on_device(tmp_path / "new", **changes)
    assert words in str(error.value)
    assert not (tmp_path / "new").exists()
    assert unsupported(tiny_config("x")) is None


def test_the_fused_step_gets_the_learning_rates_in_its_own_words():
    config = tiny_config("x")
    settings = step_settings(config, 2.0)
    assert settings.lr["means"] == 2.0 * config.lr.means
    assert settings.lr["shN"] == config.lr.sh_rest
    assert set(settings.lr) == {"means", "scales", "quats", "opacities", "sh0", "shN"}
    assert settings.blur_pixels(WIDTH * HEIGHT) == int(0.02 * WIDTH * HEIGHT)
    assert replace(settings, blur_min_pixels=40.0).blur_pixels(WIDTH * HEIGHT) == 40.0
