"""`pop train --backend cuda` against `--backend fast` on a tiny capture, and against itself, interrupted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from cuda_ext.render import lists
from pop_fast.cuda import stages
from pop_fast.density import GsplatStrategy, POPStrategy
from pop_fast.train import TrainingRun, training_run
from pop_ref.conformance.mutants.trial import every_law, law_named
from tests.app.tiny import HEIGHT, WIDTH, last_checkpoint, records, run_until, tiny_capture, tiny_config
from tests.cuda.gpu.scene import FusedStep, assert_same_bits, skip_what_is_refused
from tests.train.test_steps import climb, ladder_agree

COMPARED = ("loss", "pop", "psnr", "d_ssim", "l1", "l2", "lr_means", "num_gaussians")
STILL = {"refine_stop_iter": 0}


def masked(capture):
    mask = np.ones((HEIGHT, WIDTH), dtype=bool)
    mask[:, 20:] = False
    views = [replace(view, mask=mask if k != 2 else None) for k, view in enumerate(capture.views)]
    return replace(capture, views=tuple(views))


def mixed_sizes(capture):
    small = replace(capture.views[2], image=np.ascontiguousarray(capture.views[2].image[:-5, :-3]))
    return replace(capture, views=(*capture.views[:2], small, *capture.views[3:]))


WINDOW = {"pop_views": "window", "refine_start_iter": 8, "refine_stop_iter": 7}
ENTROPY = {"lambda_pop": 0.0, "lambda_entropy": 0.05}
REGULARIZERS = {"opacity_reg": 0.1, "scale_reg": 0.05}
# settings, of the strategy too, and what becomes of the capture
CASES = {
    "plain": {},
    "masks": {"edit": masked},
    "sizes": {"edit": mixed_sizes},
    "background": {"background": (0.25, 0.5, 1.0), "antialiased": True},
    "losses": {"l2_stop_iter": 4, "d_ssim_halved": True, "ssim_padding": "same"},
    "inria": {"profile": "inria", "photometric_divisor": 2.0},
    "gsplat": {"profile": "gsplat_1_6", "sh_interval": 2},
    "visible": {"strategy": {"pop_over": "visible"}},
    "window": {"strategy": WINDOW},
    "entropy": {"strategy": ENTROPY},
    "regularizers": {**REGULARIZERS, "strategy": {"lambda_entropy": 0.05}},
    "batch, regularizers": {"batch_size": 2, **REGULARIZERS, "strategy": ENTROPY},
    "any view": {"strategy": {"blur_window": "any_view"}, "edit": masked},
    "batch": {"batch_size": 3, "edit": lambda capture: masked(mixed_sizes(capture))},
    "batch, window": {"batch_size": 2, "strategy": WINDOW},
    "batch, visible": {"batch_size": 2, "sh_interval": 2, "strategy": {"pop_over": "visible"}, "edit": masked},
}


@pytest.mark.parametrize("case", CASES)
def test_steps_are_the_cpus_under_every_setting(engine, case, tmp_path):
    changes = dict(CASES[case])
    capture = changes.pop("edit", lambda capture: capture)(tiny_capture())
    # Gaussians that stay, and rates at which rounding does not grow
    strategy = POPStrategy(**{**STILL, "pop_stop_iter": 6, **changes.get("strategy", {})})
    settings = {"max_steps": 8, "log_every": 1, "checkpoint_every": 0, **changes, "strategy": strategy}
    rates = replace(tiny_config("x").lr, quats=0.0)
    expected = TrainingRun(tiny_config(tmp_path / "cpu", lr=rates, **settings), capture).run()
    on_gpu = tiny_config(tmp_path / "gpu", lr=rates, **settings)
    found = TrainingRun(on_gpu, capture, engine=engine).run()
    for ours, theirs in zip(records(tmp_path / "gpu"), records(tmp_path / "cpu"), strict=True):
        assert ours.pop("view") == theirs.pop("view")
        compared = {key: value for key, value in theirs.items() if key in COMPARED}
        assert {key: ours.get(key, 0.0) for key in compared} == pytest.approx(compared, rel=2e-3), (case, ours["step"])
    assert found["psnr"] == pytest.approx(expected["psnr"], abs=0.02)
    assert found["n_blended"] == pytest.approx(expected["n_blended"], rel=0.02)


@pytest.mark.parametrize("method", ["pop", "gsplat"])
def test_densification_steps_come_when_the_cpus_come_and_change_about_as_many(engine, method, tmp_path):
    TrainingRun(tiny_config(tmp_path / "cpu", method=method), tiny_capture()).run()
    TrainingRun(tiny_config(tmp_path / "gpu", method=method), tiny_capture(), engine=engine).run()
    ours, theirs = ([r for r in records(tmp_path / name) if "cloned" in r] for name in ("gpu", "cpu"))
    assert [change["step"] for change in ours] == [change["step"] for change in theirs]
    first, wanted = ours[0], theirs[0]
    for key in ("cloned", "split", "pruned", "num_gaussians"):
        assert abs(first[key] - wanted[key]) <= 2, key
    assert ours[-1]["num_gaussians"] == pytest.approx(theirs[-1]["num_gaussians"], rel=0.2)
    assert [change.get("reset") for change in ours] == [change.get("reset") for change in theirs]


@pytest.mark.parametrize("method", ["pop", "gsplat"])
def test_an_interrupted_run_goes_on_to_the_same_bits(engine, method, tmp_path):
    settings = {"method": method, "strategy": replace(tiny_config("x", method="gsplat").strategy, reset_every=7)}
    for name, stops in (("whole", (None,)), ("parts", (8, 16, 23, None))):
        for place, stop in enumerate(stops):
            config = tiny_config(tmp_path / name, **settings)
            run_until(TrainingRun(config, tiny_capture(), engine=engine, resume=place > 0), stop)
    ours, theirs = (last_checkpoint(tmp_path / name) for name in ("parts", "whole"))
    arrays = [name for name in theirs if name.startswith((".splats", ".optimizers"))]
    assert len(arrays) > 12
    assert all(torch.equal(ours[name], theirs[name]) for name in arrays)


def test_buffers_that_overflow_between_views_of_several_sizes_lose_nothing(engine, tmp_path, monkeypatch):
    capture = mixed_sizes(tiny_capture())
    whole = TrainingRun(tiny_config(tmp_path / "whole"), capture, engine=engine)
    whole.run()
    monkeypatch.setattr(lists, "FIRST_GUESS", (0, 1))
    cramped = TrainingRun(tiny_config(tmp_path / "cramped"), capture, engine=engine)
    assert cramped.run()["instance_buffers_grown"] > 0
    assert_same_bits(cramped.params, whole.params)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_photographs_without_room_pass_through_to_the_same_bits(engine, tmp_path, monkeypatch, batch_size):
    capture = masked(mixed_sizes(tiny_capture()))
    runs = []
    monkeypatch.setattr(stages, "MOMENTS_SHARE", 0.0)
    # room for all, for some, and for none
    for name, share in (("all", 1.0), ("some", 0.6), ("none", 0.0)):
        most = runs[0].stepper.facts()["photograph_bytes"] if runs else 1 << 30
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_, free=most: (free, free))
        monkeypatch.setattr(stages, "PHOTOGRAPHS_SHARE", share)
        runs.append(TrainingRun(tiny_config(tmp_path / name, batch_size=batch_size), capture, engine=engine))
        runs[-1].run()
    facts = [run.stepper.facts() for run in runs]
    n = len(runs[0].stepper.task.views)
    assert [told["photographs_passing"] for told in facts] == [0, facts[1]["photographs_passing"], n]
    assert 0 < facts[1]["photographs_passing"] < n
    assert facts[0]["photograph_bytes"] > facts[1]["photograph_bytes"] > facts[2]["photograph_bytes"] > 0
    assert [run.stepper.fused.views.copied > 0 for run in runs] == [False, True, True]
    for run in runs[1:]:
        assert_same_bits(run.params, runs[0].params)


def test_a_number_that_is_not_finite_is_found_on_the_device(engine, tmp_path):
    trainer = TrainingRun(tiny_config(tmp_path, strategy=GsplatStrategy()), tiny_capture(), engine=engine)
    take_steps = trainer.take_steps

    def poisoned(last):
        found = take_steps(last)
        if last == 5:
            trainer.params["quats"].data[7, 2] = float("nan")
        return found

    trainer.take_steps = poisoned
    with pytest.raises(ValueError, match=r"quats\[7, 2\] is nan after 5 steps; no checkpoint is kept"):
        trainer.run()


# The golden ladder, and the laws of whole steps of the kit: every step is the oracle's from the same Gaussians.


@pytest.fixture
def whole_steps(engine, monkeypatch):
    def engine_of(config, own_strategy):
        skip_what_is_refused(config)
        return engine

    monkeypatch.setattr(training_run, "engine_of", engine_of)
    return FusedStep("pop_fast", "fast", "float32")


OFFERED = {"taken_steps", "batched_steps", "whole_run"}
LAWS = [path for path, law in every_law().items() if set(law.needs) <= OFFERED and law.needs]


@pytest.mark.parametrize("path", LAWS)
def test_whole_steps_are_as_the_laws_say(whole_steps, path):
    law_named(path).sentence(whole_steps)


def test_ten_losses_are_the_oracles(engine, tmp_path):
    ladder_agree(climb(engine, tmp_path), torch.float32)
