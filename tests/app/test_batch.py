"""A step of several views: the mean of their losses, and to density control the views one after the other."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

import pop_fast.compiled
from pop_fast.api.registry import require_backend
from pop_fast.cuda.backend import CUDA
from pop_fast.density import POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.batch_stepper import BatchStepper
from pop_fast.train.engines import engine_of, torch_engine
from pop_fast.train.fused_stepper import FusedStepper
from pop_fast.train.schedule import phase_at
from pop_fast.train.stepper import Task
from pop_fast.train.torch_stepper import TorchStepper
from pop_fast.train.whole_step import why_not_trained
from tests.app.tiny import HEIGHT, WIDTH, tiny_capture, tiny_config

# bands of colour, growth by blur and the prior are all on at this step
STEP = 12
VIEWS = [2, 0, 3]


def one_step(views: list[int], mask: Any = None, **plan: Any) -> tuple[Any, Any]:
    """Take one step at STEP of these views, without density control; return the run and its measurements."""
    config = tiny_config("unused", batch_size=len(views), strategy=strategy(**plan), log_every=1)
    start = TrainingRun(config, tiny_capture(mask=mask))
    initial = {key: value.detach().double() for key, value in start.params.items()}
    initial["shN"] += 0.05
    run: Any = TrainingRun(config, tiny_capture(mask=mask), initial=initial)
    order = [0] * len(views) * STEP + views
    task = Task(config, run.strategy, run._train, order, run.updates, STEP, run.appearance)
    kind = TorchStepper if len(views) == 1 else BatchStepper
    stepper = kind(task, require_backend("fast"))
    stepper.rebind(run.params, run.optimizers, run.state)
    (stats,) = stepper.steps(STEP, STEP + 1, phase_at(config, run.strategy, STEP))
    return run, stats


def strategy(**plan: Any) -> POPStrategy:
    return POPStrategy(
        refine_start_iter=3, refine_stop_iter=24, blur_start_iter=8, blur_stop_iter=16, theta_blur=0.02, **plan
    )


def moment(run: Any, key: str) -> torch.Tensor:
    return run.optimizers[key].state[run.params[key]]["exp_avg"]


def test_the_gradient_of_a_batch_is_the_mean_of_its_views_gradients() -> None:
    batch, stats = one_step(VIEWS)
    alone = [one_step([view]) for view in VIEWS]
    for key in batch.params:
        # Adam's first moment, from zero, is a tenth of the gradient
        expected = torch.stack([moment(run, key) for run, _ in alone]).mean(0)
        assert expected.abs().max() > 0
        assert torch.allclose(moment(batch, key), expected, rtol=1e-12, atol=1e-18), key
    for name in ("objective", "pop", "square", "pixelwise", "ssim", "n_blended"):
        values = [getattr(found, name) for _, found in alone]
        assert getattr(stats, name) == pytest.approx(sum(values) / len(VIEWS), rel=1e-12)
        assert len(set(values)) > 1 or name == "pop"
    assert stats.pop > 0.0


@pytest.mark.parametrize("window", ["any_view", "last_view", "sum"])
@pytest.mark.parametrize("masked", [False, True])
def test_density_control_sees_the_views_one_after_the_other(window: str, masked: bool) -> None:
    mask = (torch.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 3 > 0).numpy() if masked else None
    plan = {"blur_window": window, "refine_scale2d_stop_iter": 20}
    batch, _ = one_step(VIEWS, mask, **plan)
    alone = [one_step([view], mask, **plan)[0].state for view in VIEWS]
    state = batch.state
    for key in ("grad2d", "count"):
        assert torch.allclose(state[key], torch.stack([one[key] for one in alone]).sum(0), rtol=1e-12), key
    assert state["count"].max() == len(VIEWS)
    assert state["views"] == len(VIEWS)
    assert torch.equal(state["radii"], torch.stack([one["radii"] for one in alone]).amax(0))
    blurred = torch.stack([one["blurred"] for one in alone])
    if window == "sum":
        total = torch.stack([one["dominant_sum"] for one in alone]).sum(0)
        assert torch.equal(state["dominant_sum"], total)
        kept = HEIGHT * WIDTH if mask is None else int(mask.sum())
        assert torch.equal(state["blurred"], total > batch.config.strategy.theta_blur * kept)
    else:
        assert torch.equal(state["blurred"], blurred.any(0) if window == "any_view" else blurred[-1])
    assert blurred.any()
    assert len({tuple(row.tolist()) for row in blurred}) > 1


def test_a_run_of_batches_draws_as_many_views_a_step_and_continues_to_the_same_bits(tmp_path: Path) -> None:
    capture = tiny_capture()
    whole = TrainingRun(tiny_config(tmp_path / "whole", batch_size=3), capture)
    whole.run()
    records = [json.loads(line) for line in (tmp_path / "whole" / "metrics.jsonl").read_text().splitlines()]
    assert all(len(record["view"].split(", ")) == 3 for record in records)
    assert any(record.get("cloned", 0) + record.get("split", 0) > 0 for record in records)
    config = tiny_config(tmp_path / "parts", batch_size=3)
    first = TrainingRun(config, capture)
    take_steps = first.take_steps

    def until_17(last: int) -> Any:
        if first.step == 17:
            raise KeyboardInterrupt
        return take_steps(last)

    first.take_steps = until_17
    with pytest.raises(KeyboardInterrupt):
        first.run()
    second = TrainingRun(config, capture, resume=True)
    second.run()
    for key, value in whole.params.items():
        assert torch.equal(value, second.params[key])
    with pytest.raises(PopError, match="batch_size = 3, but this run has batch_size = 2"):
        TrainingRun(tiny_config(tmp_path / "parts", batch_size=2), capture, resume=True).run()


def test_checkpoints_of_one_view_a_step_say_nothing_of_batches() -> None:
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


@pytest.mark.skipif(pop_fast.compiled.why_not() is not None, reason="the CPU kernels are not compiled")
def test_the_step_in_cpp_leaves_batches_to_autograd() -> None:
    one = engine_of(tiny_config("x", backend="compiled"))
    several = engine_of(tiny_config("x", backend="compiled", batch_size=2))
    assert isinstance(TrainingRun(tiny_config("x"), tiny_capture(), engine=one).stepper, FusedStepper)
    run = TrainingRun(tiny_config("x", batch_size=2), tiny_capture(), engine=several)
    assert isinstance(run.stepper, BatchStepper)


def test_the_fused_step_on_a_gpu_refuses_batches() -> None:
    reason = why_not_trained(CUDA, tiny_config("x", batch_size=2))
    assert reason is not None
    assert "batch_size = 1 only, not 2; use --backend fast, or leave batch_size as it is" in reason


def test_a_strategy_of_somebody_else_takes_one_view_a_step() -> None:
    with pytest.raises(PopError, match="batch_size is 2; it must be 1 with a strategy of somebody else"):
        TrainingRun(tiny_config("x", batch_size=2), tiny_capture(), strategy=POPStrategy(), engine=torch_engine("fast"))
    with pytest.raises(PopError, match="batch_size is 0; it must be at least 1"):
        tiny_config("x", batch_size=0)
