"""The benchmark's first case has the loads that times were predicted for, counted by the kernels themselves."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[3] / "benchmarks"
# what the predictions in benchmarks/NOTES.md are for, of the whole image, and of each of its pixels
VISIBLE, INSTANCES, EVALUATED, CONTRIBUTING = 160_000, 2_000_000, 120.0, 35.0
BY = 6


@pytest.mark.slow
def test_the_predicted_case_is_what_was_predicted(gpu, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_scenes import CASES, activated_scene
    from gpu_steps import POP, make_trainer, step_loads

    whole, case = CASES[0], CASES[0].smaller(BY)
    assert (whole.n, whole.width * whole.height) == (270_000, pytest.approx(1.6e6, rel=0.01))
    photograph = torch.zeros((case.height, case.width, 3), dtype=torch.uint8)
    trainer = make_trainer(activated_scene(case, gpu), photograph, 2, replay=False, counts=True)
    trainer.run(1, POP)
    loads = step_loads(trainer)
    assert loads.visible * BY**2 == pytest.approx(VISIBLE, rel=0.05)
    # a small image cuts long splats off at its border: of the whole image the lists are a tenth longer
    assert loads.instances * BY**2 == pytest.approx(0.9 * INSTANCES, rel=0.1)
    assert loads.evaluated / loads.pixels == pytest.approx(EVALUATED, rel=0.1)
    assert loads.contributing / loads.pixels == pytest.approx(CONTRIBUTING, rel=0.1)
    # lists are as unequal as those of captures
    ((size, told),) = trainer.render_stats().items()
    assert size == (case.width, case.height)
    walked = told["n_traversed"].float()
    assert float(walked.quantile(0.99)) > 1.5 * float(walked.mean())
