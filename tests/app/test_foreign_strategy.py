"""A strategy of other people, written to gsplat's protocol and knowing nothing of ours, decides over a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from pop_fast.density import DensificationStep, POPStrategy
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from tests.app.test_resume import assert_same_run
from tests.app.tiny import tiny_capture, tiny_config


@dataclass
class Jitter:
    """Every fourth step the Gaussian that moved most on the screen gets a copy nearby, placed by torch's numbers."""

    every: int = 4
    tells: bool = False

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        assert set(params) == set(optimizers)

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        return {"grad2d": None, "count": None, "scene_scale": scene_scale, "jitter": torch.tensor(0.1), "seen": 0}

    def step_pre_backward(self, params: Any, optimizers: Any, state: Any, step: int, info: Any) -> None:
        info["means2d"].retain_grad()

    def step_post_backward(
        self, params: Any, optimizers: Any, state: Any, step: int, info: Any, packed: bool = False
    ) -> Any:
        assert not packed
        state["seen"] += 1
        moved = info["means2d"].grad[0].norm(dim=-1)
        state["grad2d"] = moved if state["grad2d"] is None else state["grad2d"] + moved
        state["count"] = torch.ones_like(moved)
        if step % self.every:
            return None
        source = int(state["grad2d"].argmax())
        for key, optimizer in optimizers.items():
            old = params[key]
            row = old.detach()[source : source + 1].clone()
            if key == "means":
                row += state["jitter"] * torch.randn(1, 3)
            new = torch.nn.Parameter(torch.cat([old.detach(), row]))
            moments = optimizer.state.pop(old)
            grown = {k: v if k == "step" else torch.cat([v, torch.zeros_like(row)]) for k, v in moments.items()}
            optimizer.state[new] = grown
            optimizer.param_groups[0]["params"] = [new]
            params[key] = new
        state["grad2d"] = state["count"] = None
        return DensificationStep(cloned=1) if self.tells else None


def run(folder: Any, stop_after: int | None = None, resume: bool = False, **options: Any) -> TrainingRun:
    training = TrainingRun(tiny_config(folder), tiny_capture(), strategy=Jitter(**options), resume=resume)
    take_steps = training.take_steps

    def stepping(last: int) -> Any:
        if training.step == stop_after:
            raise KeyboardInterrupt
        return take_steps(last)

    training.take_steps = stepping
    if stop_after is None:
        training.run()
    else:
        with pytest.raises(KeyboardInterrupt):
            training.run()
    return training


def test_it_decides_over_the_population_and_the_loss_falls(tmp_path):
    n = len(tiny_capture().points)
    training = run(tmp_path)
    # steps 0, 4, ... 28
    assert len(training.params["means"]) == n + 8
    stats = json.loads((tmp_path / "stats" / "val_step0029.json").read_text())
    assert (stats["num_GS"], stats["stepper"], stats["method"]) == (n + 8, "torch", "Jitter")
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert records[-1]["loss"] < records[0]["loss"]
    assert not any("cloned" in record or "pop" in record for record in records)


def test_what_it_says_of_a_change_goes_into_the_records(tmp_path):
    run(tmp_path, every=5, tells=True)
    records = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [record["step"] for record in records if "cloned" in record] == [0, 5, 10, 15, 20, 25]
    assert all(record["cloned"] == 1 and record["pruned"] == 0 for record in records if "cloned" in record)


def test_a_run_that_is_resumed_goes_on_to_the_same_bits_whatever_it_drew_with(tmp_path):
    run(tmp_path / "whole")
    for place, stop_after in enumerate((7, 11, 18)):
        torch.manual_seed(stop_after)
        run(tmp_path / "parts", stop_after, resume=place > 0)
    run(tmp_path / "parts", resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")


def test_our_own_strategies_follow_the_protocol_too(tmp_path):
    own = tiny_config("x").strategy
    assert isinstance(own, POPStrategy)
    given = TrainingRun(tiny_config(tmp_path / "given"), tiny_capture(), strategy=own)
    given.run()
    named = TrainingRun(tiny_config(tmp_path / "named"), tiny_capture())
    # by gsplat's protocol a strategy is not told a seed
    named.state["generator"].manual_seed(0)
    named.run()
    for key, value in named.params.items():
        assert torch.equal(given.params[key], value), key


def test_a_gpu_trains_with_the_strategies_of_this_package(tmp_path, monkeypatch):
    monkeypatch.setattr("cuda_ext.why_not", lambda: None)
    with pytest.raises(PopError, match="strategies of this package only; use --backend fast"):
        TrainingRun(tiny_config(tmp_path, backend="cuda"), tiny_capture(), strategy=Jitter())
