"""Inria's near plane is a length of the capture's own world: what a run draws, trains, records and hands on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pop_fast.blocks import jobs
from pop_fast.data import Capture, View, load_capture
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.results import read_config
from tests.app.conftest import Pop
from tests.app.test_blocks import in_this_process
from tests.app.test_methods import engine_or_skip, tiny_method
from tests.app.tiny import tiny_capture

SHORT = ("--method", "3dgs", "--steps-scaler", "0.001", "--no-progress", "--skip-checks", "--skip-sizes")


def scaled(capture: Capture, scale: float) -> Capture:
    """Say that the capture's own world was scaled by so much to make the one that it is in."""
    return replace(capture, world_transform=np.diag([scale, scale, scale, 1.0]))


CASES = {
    "3dgs": (0.25, True),
    "3dgs in its own world": (1.0, False),
    "speedy-splat": (0.25, True),
    "gsplat": (1.0, True),
}


@pytest.mark.parametrize("backend", ["fast", "compiled"])
@pytest.mark.parametrize("case", CASES)
def test_a_gaussian_at_half_of_inrias_near_plane_is_seen_where_the_world_was_shrunk(
    case: str, backend: str, tmp_path: Path
) -> None:
    engine_or_skip(backend)
    (scale, is_seen), capture = CASES[case], tiny_capture()
    eye, *others = capture.train_views(5)
    config = tiny_method(tmp_path, case.split()[0], backend=backend, test_every=5)
    initial = {key: value.detach().clone() for key, value in TrainingRun(config, capture).params.items()}
    # a tenth of the world's unit in front of one camera; the others are far away
    place = eye.camera_center + 0.1 * eye.viewmat[2, :3]
    initial["means"][0], initial["scales"][0] = torch.tensor(place), -6.0
    run = TrainingRun(config, scaled(capture, scale), initial=initial)
    run.take_steps(1 + len(others))
    assert int(run.state["count"][0]) == is_seen + sum(_shows(view, place) for view in others)


def _shows(view: View, place: np.ndarray) -> bool:
    x, y, z = view.viewmat[:3, :3] @ place + view.viewmat[:3, 3]
    u, v = (view.K @ [x, y, z])[:2] / z
    return bool(z > 1.0 and 0.0 <= u <= view.width and 0.0 <= v <= view.height)


def test_a_run_writes_its_near_plane_down_and_goes_on_with_it(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    scale = load_capture(shared_capture).world_scale
    assert abs(scale - 1.0) > 0.1
    out = tmp_path / "out"
    assert pop("train", shared_capture, "--out", out, *SHORT).status == 0
    near = json.loads((out / "cfg.json").read_text())["resolved"]["near_plane"]
    assert near == pytest.approx(0.2 * scale, rel=1e-12)
    again = pop("train", shared_capture, "--out", out, *SHORT, "--resume")
    assert (again.status, read_config(out).near_plane) == (0, near)
    splat = load_splat(out)
    assert open_capture(splat, CaptureOptions())[1].renderer.near_plane == near
    # in the capture's own world it is Inria's number
    own = open_capture(splat, CaptureOptions(own_frame=True))[1]
    assert own.renderer.near_plane == pytest.approx(0.2, rel=1e-12)


def test_blocks_are_trained_with_the_near_plane_of_the_whole(
    pop: Pop, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_run", in_this_process)
    monkeypatch.setattr(jobs, "has_snakemake", lambda: False)
    scale, out = load_capture(shared_capture).world_scale, tmp_path / "out"
    words = ("train", shared_capture, "--out", out, *SHORT, "--blocks", "2x1", "--blocks-rounds", "0", "--threads", "1")
    for more in ((), ("--resume",)):
        assert pop(*words, *more).status == 0
    found = {path.parent: read_config(path.parent).near_plane for path in out.rglob("cfg.json")}
    assert len(found) > 2
    assert list(found.values()) == [pytest.approx(0.2 * scale, rel=1e-12)] * len(found)


def test_what_is_said_is_taken_and_other_profiles_have_their_own() -> None:
    said = TrainConfig.of(method="3dgs", near_plane=0.5).in_world(0.25)
    assert said.renderer.near_plane == 0.5
    assert TrainConfig.of(method="gsplat").in_world(0.25).near_plane is None
    assert TrainConfig.of(method="gsplat").renderer.near_plane == 0.01
    # settings of before there were others bind a resumed run as they did
    assert "near_plane" not in TrainConfig().binding()
    assert TrainConfig.of(method="3dgs").in_world(0.25).binding()["near_plane"] == 0.05
