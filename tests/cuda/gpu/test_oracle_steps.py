"""The golden ladder, and steps of a real run each judged by the oracle's from the same state; see `tests.train`."""

from __future__ import annotations

import pytest
import torch

from tests.train import test_rules as rules
from tests.train.scene import RECIPE, SHORT, STEPS
from tests.train.test_steps import EVERYTHING, agree, judged, run_of
from tests.train.test_ten_losses import agree as climbed
from tests.train.test_ten_losses import climb


@pytest.mark.parametrize(("recipe", "steps"), [(SHORT, 10), (RECIPE, STEPS)], ids=["ten", "three-hundred"])
def test_every_step_is_the_oracles(engine, recipe, steps, tmp_path):
    found = judged(run_of(recipe, tmp_path, engine), recipe, steps)
    agree(found)
    happened = {kind for step in found for kind in step.happened}
    assert happened == EVERYTHING if recipe is RECIPE else happened


def test_the_rules_of_updates_move_whom_they_move_and_nobody_else(engine, tmp_path):
    rules.test_each_engine_moves_whom_the_rules_move_and_nobody_else(engine, tmp_path / "moves")
    rules.test_gradients_that_wait_are_summed_alike_by_every_engine(engine, tmp_path / "waits")


def test_ten_losses_are_the_oracles(engine, tmp_path):
    climbed(climb(engine, tmp_path), torch.float32)
