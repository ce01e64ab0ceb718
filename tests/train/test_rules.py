"""What methods change of an update and of density control: against the oracle in float64, and on every engine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.data.initialize import initialize_params
from pop_fast.density.protocol import Draws
from pop_fast.train import TrainingRun
from pop_fast.train.engines import torch_engine
from pop_ref.optimizer import is_updated
from pop_ref.records import Camera
from pop_ref.settings import Recipe, UpdateRules
from pop_ref.training import train_step
from tests.train.oracle_steps import KEYS, config_of, state_of
from tests.train.scene import SHORT, capture

RULES = UpdateRules(
    edits_replace_update=True,
    sh_start_iter=2,
    sh_rest_every=3,
    opacities_stop_iter=7,
    means_rewind_iter=5,
    means_rewind_to=1,
)
UPDATES = replace(SHORT, updates=RULES, sh_interval=1)
ENTROPY = replace(SHORT, lambda_pop=0.0, lambda_entropy=0.3)
BOTH_PRIORS = replace(SHORT, lambda_entropy=0.3)
PRUNED = replace(SHORT, density=replace(SHORT.density, final_prune_iter=9, final_prune_opa=0.4))


def normals(n: int) -> np.ndarray:
    return np.random.default_rng(n).standard_normal((2, n, 3))


def run_of(recipe: Recipe, folder: Path, engine: Any, dtype: torch.dtype) -> TrainingRun:
    initial = initialize_params(capture(), 7, 0.4, 0.6, dtype)
    # of a sphere the rotation has no gradient but rounding, along which Adam takes whole steps
    initial["scales"] += torch.linspace(-0.5, 0.5, initial["scales"].numel(), dtype=dtype).reshape(-1, 3).sin()
    run = TrainingRun(config_of(recipe, folder, seed=7), capture(), engine=engine, initial=initial)
    run.draws = Draws(lambda n: torch.tensor(normals(n)), lambda n: torch.rand(n, dtype=torch.float64))
    return run


@pytest.mark.parametrize(
    "recipe",
    [UPDATES, ENTROPY, BOTH_PRIORS, PRUNED],
    ids=["updates", "entropy", "both", "pruned"],
)
def test_ten_steps_in_double_precision_are_the_oracles(recipe: Recipe, tmp_path: Path) -> None:
    run = run_of(recipe, tmp_path, torch_engine("fast"), torch.float64)
    state = state_of(run)
    for step in range(10):
        segment = run.take_steps(step + 1)
        view = next(view for view in run._train if view.name == segment.views[0])
        camera = Camera(view.viewmat[0].numpy(), view.K[0].numpy(), view.width, view.height)
        scene_scale = capture().scene_scale()
        state, loss = train_step(state, camera, view.photo.double().numpy() / 255.0, scene_scale, normals, recipe)
        assert segment.stats[0].objective + segment.stats[0].pop == pytest.approx(loss, rel=1e-10)
        for key in KEYS:
            np.testing.assert_allclose(run.params[key].detach().numpy(), state.rows.params[key], rtol=1e-7, atol=1e-9)


def test_each_engine_moves_whom_the_rules_move_and_nobody_else(engine: Any, tmp_path: Path) -> None:
    run = run_of(UPDATES, tmp_path, engine, torch.float32)
    idle = 0
    for step in range(10):
        before = {key: run.params[key].detach().clone() for key in KEYS}
        densification = run.take_steps(step + 1).densification
        if densification is not None:
            continue
        for key in KEYS:
            moved = not torch.equal(before[key], run.params[key].detach())
            # bands beyond the first have no gradient before they are drawn
            wanted = is_updated(key, step, UPDATES) and (key != "shN" or step > RULES.sh_start_iter)
            assert moved == wanted, f"{key} at step {step}"
            idle += not moved
    assert idle > 5


def test_gradients_that_wait_are_summed_alike_by_every_engine(engine: Any, tmp_path: Path) -> None:
    still = replace(UPDATES, density=replace(UPDATES.density, refine_start_iter=10**6))
    runs = [
        run_of(still, tmp_path / name, of, torch.float32) for name, of in (("a", engine), ("b", torch_engine("fast")))
    ]
    for step in range(10):
        for run in runs:
            run.take_steps(step + 1)
    bands = [run.optimizers["shN"].state[run.params["shN"]]["exp_avg"].cpu() for run in runs]
    largest = float(bands[1].abs().max())
    assert largest > 0.0
    # a moment is linear in the sums; gradients themselves differ by rounding
    torch.testing.assert_close(bands[0], bands[1], rtol=1e-3, atol=1e-3 * largest)
