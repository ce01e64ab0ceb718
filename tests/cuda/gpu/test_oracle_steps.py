"""Steps of a real run on the GPU, each judged by the oracle's step from the same state; see `tests.train`."""

from __future__ import annotations

import pytest

from tests.train.scene import RECIPE, SHORT, STEPS
from tests.train.test_steps import EVERYTHING, agree, judged, run_of


@pytest.mark.parametrize(("recipe", "steps"), [(SHORT, 10), (RECIPE, STEPS)], ids=["ten", "three-hundred"])
def test_every_step_is_the_oracles(engine, recipe, steps, tmp_path):
    found = judged(run_of(recipe, tmp_path, engine), recipe, steps)
    agree(found)
    happened = {kind for step in found for kind in step.happened}
    assert happened == EVERYTHING if recipe is RECIPE else happened
