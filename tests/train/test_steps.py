"""The ladder of ten losses, climbed by the run that trains, on every engine; the laws judge every single step."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.data.capture import Capture, View
from pop_fast.density import POPStrategy
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.engines import torch_engine
from pop_fast.train.presets import values_of
from pop_ref.settings import DensityConfig, PopTerm, Recipe, UpdateRules
from tests.app.tiny import tiny_capture, tiny_config
from tests.golden import ten_losses
from tests.golden.ten_losses import RECIPE, SCENE_SCALE, STEPS, Rung


def config_of(recipe: Recipe, folder: Any, **changes: Any) -> TrainConfig:
    """Return the settings of a run that does what a recipe says, over views that are all trained on."""
    density = {f.name: getattr(recipe.density, f.name) for f in fields(DensityConfig)}
    term = {f.name: getattr(recipe, f.name) for f in fields(PopTerm)}
    rules = {f.name: getattr(recipe.updates, f.name) for f in fields(UpdateRules)}
    settings: dict[str, Any] = {
        "result_dir": str(folder),
        **values_of(recipe),
        "strategy": POPStrategy(**density, **term, **rules),
        "test_every": 0,
        "threads": 1,
        "progress": False,
        **changes,
    }
    return TrainConfig(**settings)


def test_an_opacity_next_to_one_can_leave_again_by_every_engine(engine: Any, tmp_path: Path) -> None:
    run = TrainingRun(tiny_config(tmp_path), tiny_capture(), engine=engine)
    # o (1 - o) is 2e-9 there, and 1 - o is 0 in float32
    run.params["opacities"].data.fill_(20.0)
    run.take_steps(1)
    moments = run.optimizers["opacities"].state[run.params["opacities"]]["exp_avg"].cpu()
    assert float(moments.abs().max()) > 0.0


# float64 as the oracle itself (measured: 3e-16); float32 some ten times the worst rung's error
RELATIVE = {torch.float64: 1e-9, torch.float32: 1.2e-6}


class ScaledCapture(Capture):
    """Three views of a scene whose scale is the ladder's."""

    def scene_scale(self) -> float:
        return SCENE_SCALE


class InTurn:
    """In the place of a random order: the views one after the other."""

    def __init__(self) -> None:
        self.taken = 0

    def next(self) -> int:
        self.taken += 1
        return (self.taken - 1) % 3

    def ahead(self, count: int) -> list[int]:
        return [(self.taken + step) % 3 for step in range(count)]


def climb(engine: Any, folder: Path, dtype: torch.dtype = torch.float32) -> list[Rung]:
    views = [
        View(f"{i}.png", np.round(255.0 * photo).astype(np.uint8), camera.viewmat, camera.K)
        for i, (photo, camera) in enumerate(zip(ten_losses.photographs(), ten_losses.cameras(), strict=True))
    ]
    capture = ScaledCapture("ladder", tuple(views), np.zeros((1, 3)), np.zeros((1, 3), np.uint8), source="formulas")
    initial = {name: torch.tensor(array, dtype=dtype) for name, array in ten_losses.first_params().items()}
    config = config_of(RECIPE, folder / "run", sh_degree=1)
    run = TrainingRun(config, capture, engine=engine, initial=initial)
    run._order = InTurn()
    run.draws = replace(run.draws, normals=lambda n: torch.tensor(ten_losses.draws(n)))
    rungs = []
    for step in range(STEPS):
        segment = run.take_steps(step + 1)
        assert segment.views == [f"{step % 3}.png"]
        rungs.append(Rung(segment.stats[0].objective + segment.stats[0].pop, len(run.params["means"])))
    return rungs


def ladder_agree(rungs: list[Rung], dtype: torch.dtype) -> None:
    written = ten_losses.WRITTEN
    assert [rung.n for rung in rungs] == [rung.n for rung in written]
    np.testing.assert_allclose([r.loss for r in rungs], [r.loss for r in written], rtol=RELATIVE[dtype])


def test_ten_losses_are_the_oracles(engine: Any, tmp_path: Path) -> None:
    ladder_agree(climb(engine, tmp_path), torch.float32)


@pytest.mark.parametrize("backend", ["fast", "ref"])
def test_ten_losses_in_double_precision_are_the_oracles(backend: Any, tmp_path: Path) -> None:
    ladder_agree(climb(torch_engine(backend), tmp_path, torch.float64), torch.float64)
