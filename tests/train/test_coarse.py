"""Coarse to fine: what the first steps see is the capture, with fewer pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pop_fast import compiled
from pop_fast.errors import PopError
from pop_fast.train import TrainingRun
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import Phase
from pop_fast.train.torch_stepper import TorchStepper, ViewGradient
from pop_fast.train.views import SMALLEST_SIDE, ViewTensors, index_at, shrunk, with_shrunk
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config

needs_compiled = pytest.mark.skipif(not compiled.available(), reason=compiled.why_not() or "")


def made_view(height: int = 160, width: int = 256, mask: bool = False, alpha: bool = False) -> ViewTensors:
    generator = np.random.default_rng(5)
    K = torch.tensor([[[200.0, 0.0, 131.5], [0.0, 190.0, 77.25], [0.0, 0.0, 1.0]]])
    keep = torch.ones(height, width, dtype=torch.bool)
    keep[: height // 2] = False
    return ViewTensors(
        name="a.png",
        photo=torch.from_numpy(generator.integers(0, 256, (height, width, 3), dtype=np.uint8)),
        mask=keep if mask else None,
        viewmat=torch.eye(4)[None],
        K=K,
        alpha=torch.from_numpy(generator.integers(0, 256, (height, width), dtype=np.uint8)) if alpha else None,
    )


@pytest.mark.parametrize("factor", [2, 4])
def test_a_pixel_is_the_average_of_the_pixels_in_its_place_and_so_is_its_ray(factor):
    view = made_view(mask=True, alpha=True)
    small = shrunk(view, factor)
    assert (small.height, small.width) == (160 // factor, 256 // factor)
    blocks = view.photo.numpy().reshape(160 // factor, factor, 256 // factor, factor, 3).mean((1, 3))
    assert np.abs(small.photo.numpy() - blocks).max() <= 0.5 + 1e-4
    assert view.alpha is not None
    assert small.alpha is not None
    opacity = view.alpha.numpy().reshape(160 // factor, factor, 256 // factor, factor).mean((1, 3))
    assert np.abs(small.alpha.numpy() - opacity).max() <= 0.5 + 1e-4
    # the same point of the photograph, whose corner is (0, 0): the centre of a block, and of its pixel
    point = torch.tensor([3.0 * factor, 5.0 * factor, 1.0])
    ray, scaled = torch.linalg.solve(view.K[0], point), torch.tensor([3.0, 5.0, 1.0])
    torch.testing.assert_close(torch.linalg.solve(small.K[0], scaled), ray)
    assert small.mask is not None
    assert small.kept_pixels * factor**2 == view.kept_pixels
    assert not small.mask[: 80 // factor].any()
    assert (small.name, small.viewmat.tolist()) == (view.name, view.viewmat.tolist())


def test_sizes_that_do_not_divide_keep_the_whole_photograph():
    view = made_view(101, 131)
    small = shrunk(view, 2)
    assert (small.height, small.width) == (50, 66)
    corner = torch.tensor([131.0, 101.0, 1.0])
    ray = torch.linalg.solve(view.K[0], corner)
    torch.testing.assert_close(torch.linalg.solve(small.K[0], torch.tensor([66.0, 50.0, 1.0])), ray)


def test_a_view_is_not_shrunk_to_less_than_a_few_windows():
    assert shrunk(made_view(70, 300), 4).height == 35
    small = made_view(40, 300)
    assert shrunk(small, 4) is small
    assert min(shrunk(made_view(129, 300), 4).photo.shape[:2]) >= SMALLEST_SIDE


def test_a_mask_that_shrinking_would_empty_stays():
    view = made_view()
    keep = torch.zeros(160, 256, dtype=torch.bool)
    keep[3, 3] = True
    assert shrunk(replace(view, mask=keep), 4).kept_pixels == 1


def test_every_step_finds_its_view_at_its_size():
    views = [made_view(160, 256), made_view(128, 192)]
    stops = (3, 5)
    every = with_shrunk(views, stops)
    found = [[every[index_at(step, index, 2, stops)].width for index in (0, 1)] for step in range(7)]
    assert found == [[64, 48]] * 3 + [[128, 96]] * 2 + [[256, 192]] * 2
    assert with_shrunk(views, ()) == views


@pytest.mark.parametrize("stops", [(5, 3), (-1,), (1, 2, 3, 4, 5)])
def test_stops_that_cannot_be_are_refused(stops):
    with pytest.raises(PopError, match="coarse_stop_iters"):
        TrainConfig(coarse_stop_iters=stops)


@pytest.fixture
def tiny_may_shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    """Views of 32 x 24 px may be halved."""
    monkeypatch.setattr("pop_fast.train.views.SMALLEST_SIDE", 12)


@pytest.mark.usefixtures("tiny_may_shrink")
@pytest.mark.parametrize("backend", ["fast", pytest.param("compiled", marks=needs_compiled)])
@pytest.mark.parametrize("learned", [False, True])
def test_a_run_stopped_on_either_side_of_a_stop_goes_on_to_the_same_bits(
    backend: str, learned: bool, tmp_path: Path
) -> None:
    changes = {"backend": backend, "coarse_stop_iters": (9,), "exposure": learned}

    def run(name: str, until: int = 30, resume: bool = False) -> None:
        trainer = TrainingRun(tiny_config(tmp_path / name, **changes), tiny_capture(), resume=resume)
        if until == 30:
            trainer.run()
            return

        def stop(at: TrainingRun) -> None:
            if at.step >= until:
                raise KeyboardInterrupt

        trainer._watch = stop
        with pytest.raises(KeyboardInterrupt):
            trainer.run()

    run("whole")
    run("parts", 7)
    run("parts", 12, resume=True)
    run("parts", resume=True)
    free = ("times", "numpy", "python", "random", "result_dir")
    whole, parts = (last_checkpoint(tmp_path / name, *free) for name in ("whole", "parts"))
    same = {name for name, value in whole.items() if isinstance(value, torch.Tensor)}
    assert len(same) > 20
    for name in same:
        assert torch.equal(whole[name], parts[name]), name


@pytest.mark.usefixtures("tiny_may_shrink")
def test_steps_before_a_stop_see_fewer_pixels_and_those_after_it_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    take = TorchStepper._look

    def look(self: TorchStepper, index: int, step: int, phase: Phase) -> ViewGradient:
        found = take(self, index, step, phase)
        seen.append(tuple(found.rendered.image.shape[:2]))
        return found

    monkeypatch.setattr(TorchStepper, "_look", look)
    TrainingRun(tiny_config(tmp_path / "run", coarse_stop_iters=(9,)), tiny_capture()).run()
    assert seen == [(12, 16)] * 9 + [(24, 32)] * 21


@pytest.mark.usefixtures("tiny_may_shrink")
@needs_compiled
def test_the_native_step_and_torch_measure_the_same(tmp_path: Path) -> None:
    config = {"coarse_stop_iters": (6,), "max_steps": 9, "eval_steps": (), "save_steps": (), "log_every": 1}

    def losses(backend: str) -> list[float]:
        TrainingRun(tiny_config(tmp_path / backend, backend=backend, **config), tiny_capture()).run()
        records = (tmp_path / backend / "metrics.jsonl").read_text().splitlines()
        return [json.loads(record)["psnr"] for record in records]

    ours, theirs = losses("compiled"), losses("fast")
    assert len(ours) == 9
    assert ours == pytest.approx(theirs, abs=0.02)
