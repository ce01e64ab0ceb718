"""Captures that were prepared for a node: the same bytes as those that are loaded, and nothing else is taken."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from paper_repro import prepared
from paper_repro.train_row import capture_folder, load_capture_of, train_row
from pop_fast.data import load_capture
from pop_fast.errors import PopError
from pop_fast.train import TrainConfig
from pop_fast.train.checkpoint import capture_fingerprint
from tests.app.captures import colmap_capture
from tests.repro.made import options, toy

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A capture with a mask, a split of its own, tracks and notes."""
    found = load_capture(colmap_capture(tmp_path_factory.mktemp("capture") / "scene"))
    masks = [None, np.arange(found.views[1].width) < 9, *[None] * (len(found.views) - 2)]
    views = [
        replace(
            view,
            mask=None if mask is None else np.broadcast_to(mask, view.image.shape[:2]).copy(),
            split="test" if k == 2 else "train",
            seen=None if k == 0 else np.arange(k % 3, dtype=np.int32),
        )
        for k, (view, mask) in enumerate(zip(found.views, masks, strict=True))
    ]
    return replace(found, views=tuple(views), notes=("two lines", "of notes"))


def test_what_is_read_is_what_was_loaded(capture, tmp_path):
    config = TrainConfig()
    path = prepared.write(capture, config, tmp_path)
    assert path == prepared.path_of(tmp_path, config)
    assert [file.name for file in tmp_path.iterdir()] == ["prepared_1.npz"]
    found = prepared.read(path, config)
    assert capture_fingerprint(found, 0) == capture_fingerprint(capture, 0)
    assert (found.name, found.source, found.notes) == (capture.name, capture.source, capture.notes)
    assert np.array_equal(found.world_transform, capture.world_transform)
    for ours, theirs in zip(found.views, capture.views, strict=True):
        assert (ours.name, ours.split) == (theirs.name, theirs.split)
        assert np.array_equal(ours.image, theirs.image)
        assert (ours.mask is None) == (theirs.mask is None)
        assert (ours.seen is None) == (theirs.seen is None)
        assert ours.seen is None or np.array_equal(ours.seen, theirs.seen)


def test_a_row_that_asks_for_other_photographs_is_refused(capture, tmp_path):
    path = prepared.write(capture, TrainConfig(), tmp_path)
    with pytest.raises(PopError, match=r"prepared_1\.npz: was prepared for .*; pack it again"):
        prepared.read(path, TrainConfig(background=(1.0, 1.0, 1.0)))
    clear = replace(capture.views[0], alpha=np.full(capture.views[0].image.shape[:2], 9, np.uint8))
    with pytest.raises(PopError, match="photographs with transparency"):
        prepared.write(replace(capture, views=(clear, *capture.views[1:])), TrainConfig(), tmp_path / "clear")


def saying(arrays, **other):
    """Return what the file says in words, with some of it replaced."""
    return np.frombuffer(json.dumps(json.loads(arrays["said"].tobytes()) | other).encode(), np.uint8)


DAMAGES = {
    "sizes": lambda a: a | {"sizes": a["sizes"][:-1]},
    "residuals": lambda a: a | {"residuals": a["residuals"][:-1]},
    "splits": lambda a: a | {"said": saying(a, splits=["else"])},
    "viewmats": lambda a: a | {"viewmats": a["viewmats"][:-1]},
    "Ks": lambda a: a | {"Ks": a["Ks"].astype(np.float32)},
    "points": lambda a: a | {"points": a["points"] * np.nan},
    "points_rgb": lambda a: a | {"points_rgb": a["points_rgb"][:-1]},
    "world_transform": lambda a: a | {"world_transform": a["world_transform"][:3]},
    "masks": lambda a: a | {"masked": ~a["masked"]},
    "tracks": lambda a: a | {"tracks": a["tracks"] + 1},
    "seen": lambda a: a | {"seen": a["seen"] + 10**6},
    "said": lambda a: a | {"said": a["said"][1:]},
    "names": lambda a: a | {"said": saying(a, names=["one", "one"])},
}


@pytest.mark.parametrize("name", DAMAGES)
def test_arrays_that_do_not_fit_each_other_are_named(capture, tmp_path, name):
    path = prepared.write(capture, TrainConfig(), tmp_path)
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **DAMAGES[name](arrays))
    with pytest.raises(PopError, match=rf"prepared_1\.npz: .*\b{name}\b.*; pack it again"):
        prepared.read(path, TrainConfig())


def test_a_row_of_what_was_prepared_is_the_row_of_the_photographs(tmp_path, monkeypatch):
    how, job = options(tmp_path / "whole"), toy("l1_div_100", steps_scaler=0.001)
    before = train_row(job, how)
    folder = capture_folder(job.scene, how)
    config = job.config(data=str(folder), result_dir=str(tmp_path / "run"), progress=False)
    there = options(tmp_path / "node")
    alone = there.work / job.scene.folder
    prepared.write(load_capture_of(job, config)[0], config, alone)
    monkeypatch.setattr("pop_fast.cli.train.open_capture", lambda *words: pytest.fail("photographs were read"))
    after = train_row(job, there)
    assert (after.run, after.data_hash, after.per_view) == (before.run, before.data_hash, before.per_view)


def test_the_pack_holds_what_rows_see_of_a_scene(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_pack

    data = tmp_path / "data"
    source = colmap_capture(data / "fox")
    words = ["--no-wheels", "--data", str(data), "--prepared", "fox", "moon"]
    monkeypatch.setattr(sys, "argv", ["gpu_pack", str(tmp_path / "pack"), *words])
    assert gpu_pack.main() == 1
    told = json.loads((tmp_path / "pack" / "manifest.json").read_text())
    assert told["absent"][0].startswith("scene moon: there is no scene 'moon'")
    (path,) = (tmp_path / "pack" / "captures" / "fox").iterdir()
    found = prepared.read(path, TrainConfig(factor=int(path.stem.split("_")[1])))
    assert len(found.views) == len(load_capture(source).views)
    shutil.rmtree(data)
    assert "absent: scene moon" in capsys.readouterr().err
