"""Every file that `pop` writes shows in `pop eval`, `render` and `compare` what the run showed that it is of.

The capture is turned, moved and scaled, so that its own frame and the training frame have nothing in common: a file
that is read in the wrong one shows nothing that was photographed.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pop_fast.cli import main
from pop_fast.io.formats import default_name, format_names
from tests.app.conftest import TRAIN, Pop

# dB that a format may lose of the tiny run, by what the table of formats states; the wrong frame loses ten
LOSES = {
    "ply": 0.01,
    "gltf": 0.01,
    "spz": 0.1,
    "spz-4": 0.1,
    "sog": 0.1,
    "splat": 0.1,
    "gltf-spz": 0.1,
    "compressed-ply": 0.2,
}


@pytest.fixture(scope="module")
def turned(shared_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny capture in another world."""
    folder = Path(shutil.copytree(shared_capture, tmp_path_factory.mktemp("turned") / "toy"))
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    rotation = pycolmap.Rotation3d(Rotation.from_rotvec([1.1, -0.7, 2.0]).as_matrix())
    model.transform(pycolmap.Sim3d(3.5, rotation, np.array([40.0, -25.0, 60.0])))
    model.write(folder / "sparse" / "0")
    return folder


@pytest.fixture(scope="module")
def run(turned: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result on it, which tests only read."""
    folder = tmp_path_factory.mktemp("run") / "toy_pop"
    words = ("--out", str(folder), *TRAIN, "--steps-scaler", "0.01", "--export", "splat", "sog")
    assert main(["train", str(turned), *words]) == 0
    return folder


def stats(run: Path) -> dict[str, Any]:
    """What the run states: its PSNR, and under "encodings" that of every format."""
    path = max((run / "stats").glob("val_step*.json"))
    return json.loads(path.read_text())


def assert_shows_the_same(pop: Pop, file: Path, turned: Path, run: Path, name: str, *words: str) -> None:
    """Hold `eval`, `render` and `compare` of a file to the PSNR of its run."""
    own, folder = stats(run)["psnr"], file.parent / "views"
    about = ("--capture", turned, *words)
    outcome = pop("eval", file, *about, "--json", file.parent / "e.json")
    assert outcome.status == 0, outcome.err
    assert ("says nothing of its world" in outcome.err) == (name == "splat" and not words)
    measured = json.loads((file.parent / "e.json").read_text())["psnr"]
    assert measured == pytest.approx(own, abs=LOSES[name])
    outcome = pop("render", file, *about, "--out", folder, "--overwrite")
    assert outcome.status == 0, outcome.err
    listing = json.loads((folder / "renders.json").read_text())["renders"]
    psnrs = [psnr(folder / entry["file"], turned / "images" / entry["view"]) for entry in listing]
    # pictures are rounded to bytes
    assert float(np.mean(psnrs)) == pytest.approx(measured, abs=0.02)
    outcome = pop("compare", run, file, *about, "--markdown")
    assert outcome.status == 0, outcome.err
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in outcome.out.splitlines()]
    column = rows[0].index("PSNR")
    assert [row[column] for row in rows[2:]] == [f"{own:.2f}", f"{measured:.2f}"]
    assert rows[3][rows[0].index("method")] == file.name


def psnr(render: Path, photograph: Path) -> float:
    a, b = (cv2.imread(str(path)).astype(np.float64) / 255.0 for path in (render, photograph))
    return float(-10.0 * np.log10(((a - b) ** 2).mean()))


def test_the_two_frames_have_nothing_in_common(run: Path) -> None:
    transform = np.array(json.loads((run / "capture.json").read_text())["world_transform"])
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    assert scale < 0.5
    assert np.linalg.norm(transform[:3, 3]) > 1.0
    assert Rotation.from_matrix(transform[:3, :3] / scale).magnitude() > 0.5


@pytest.mark.parametrize("frame", [(), ("--frame", "training")], ids=["capture", "training"])
@pytest.mark.parametrize("name", format_names())
def test_an_export_shows_what_was_trained(
    pop: Pop, turned: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, frame: tuple
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = pop("export", run, "--to", name, *frame)
    assert outcome.status == 0, outcome.err
    (file,) = tmp_path.iterdir()
    # a format without room for the frame says what the commands that read it have to be told
    lost = name == "splat" and bool(frame)
    assert ("--training-frame" in outcome.err) == lost
    assert_shows_the_same(pop, file, turned, run, name, *(["--training-frame"] if lost else []))


@pytest.mark.parametrize("name", format_names())
def test_a_conversion_shows_what_was_trained(
    pop: Pop, turned: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert pop("export", run, "--out", "a.ply").status == 0
    outcome = pop("convert", "a.ply", default_name("b", name), "--to", name)
    assert outcome.status == 0, outcome.err
    assert_shows_the_same(pop, tmp_path / default_name("b", name), turned, run, name)


@pytest.mark.parametrize("name", ["splat", "sog"])
def test_what_a_training_exports_shows_what_the_training_stated(pop: Pop, run: Path, tmp_path: Path, name: str) -> None:
    # in the result's folder it has a run, which is in another frame
    outcome = pop("eval", run / "export" / f"toy_pop.{name}", "--json", tmp_path / "e.json")
    assert outcome.status == 0, outcome.err
    measured = json.loads((tmp_path / "e.json").read_text())["psnr"]
    (stated,) = (entry["psnr"] for entry in stats(run)["encodings"] if entry["format"] == name)
    assert measured == pytest.approx(stated, abs=1e-3)
    assert measured == pytest.approx(stats(run)["psnr"], abs=LOSES[name])
