"""Every step that an engine takes in a real run is the oracle's, within what rounding costs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from pop_fast.data.initialize import initialize_params
from pop_fast.train import TrainingRun
from pop_fast.train.engines import torch_engine
from tests.train.oracle_steps import Judged, config_of, judged_step
from tests.train.scene import RECIPE, SHORT, STEPS, capture

EVERYTHING = {"gradient clone", "gradient split", "blur clone", "blur split", "faint", "too big", "reset"}
# steps in which a decision was too close to its threshold for the oracle to judge; measured: at most 1 of 300
MOST_IN_DOUBT = 1


def run_of(recipe: Any, folder: Path, engine: Any, dtype: torch.dtype = torch.float32) -> TrainingRun:
    initial = initialize_params(capture(), 7, 0.4, 0.6, dtype)
    return TrainingRun(config_of(recipe, folder / "run", seed=7), capture(), engine=engine, initial=initial)


def each_judged(run: TrainingRun, recipe: Any, steps: int) -> Iterator[Judged]:
    scale = capture().scene_scale()
    return (judged_step(run, recipe, scale) for _ in range(steps))


def judged(run: TrainingRun, recipe: Any, steps: int) -> list[Judged]:
    return list(each_judged(run, recipe, steps))


def agree(steps: list[Judged]) -> None:
    wrong = [f"step {step.step}: {'; '.join(step.differences)}" for step in steps if step.differences]
    certain = [text for text, step in zip(wrong, (s for s in steps if s.differences), strict=True) if not step.doubtful]
    assert not certain, "\n".join(certain[:10])
    assert len(wrong) <= MOST_IN_DOUBT, "\n".join(wrong)


def test_ten_steps_with_all_density_control_in_reach_are_the_oracles(engine: Any, tmp_path: Path) -> None:
    steps = judged(run_of(SHORT, tmp_path, engine), SHORT, 10)
    agree(steps)
    assert [step.step for step in steps if step.densification is not None] == [3, 4, 6, 8]


def test_ten_steps_in_double_precision_are_the_oracles_to_the_last_digits(tmp_path: Path) -> None:
    steps = judged(run_of(SHORT, tmp_path, torch_engine("fast"), torch.float64), SHORT, 10)
    agree(steps)
    assert not any(step.doubtful for step in steps)


@pytest.mark.slow
def test_three_hundred_steps_with_all_density_control_are_the_oracles(engine: Any, tmp_path: Path) -> None:
    steps = judged(run_of(RECIPE, tmp_path, engine), RECIPE, STEPS)
    agree(steps)
    assert set().union(*(step.happened for step in steps)) == EVERYTHING
    # before the first reset, while the loss is the same
    assert sum(step.loss for step in steps[64:68]) < 0.8 * sum(step.loss for step in steps[:4])


WRONG = {
    "a weight of the POP term": {"lambda_pop": 1.001 * SHORT.lambda_pop},
    "a rate": {"lr": replace(SHORT.lr, scales=1.001 * SHORT.lr.scales)},
    "a weight of D-SSIM": {"lambda_ssim": 1.001 * SHORT.lambda_ssim},
    "a share that is blur": {"density": replace(SHORT.density, theta_blur=0.5)},
    "a threshold of growth": {"density": replace(SHORT.density, grow_grad2d=10.0 * SHORT.density.grow_grad2d)},
    "a step of the harmonics": {"sh_interval": 4},
}


@pytest.mark.parametrize("what", WRONG)
def test_a_run_with_another_setting_is_found_out(what: str, tmp_path: Path) -> None:
    run = run_of(replace(SHORT, **WRONG[what]), tmp_path, torch_engine("fast"))
    # the first step that is found out is enough
    assert any(step.differences and not step.doubtful for step in each_judged(run, SHORT, 10))
