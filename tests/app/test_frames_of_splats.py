"""A PLY says which world it is in, so that what is exported measures as what was trained, without being told."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from pop_fast.cli import main
from pop_fast.io.formats import default_name, format_names
from pop_fast.io.ply import Frame, frame_of, load_ply, save_ply
from tests.app.captures import assert_one_line
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import says
from tests.app.populations import make


def psnr(pop: Pop, tmp_path: Path, *words: object) -> float:
    outcome = pop.done("eval", *words, "--json", tmp_path / "e.json")
    assert "note" not in outcome.err
    return json.loads((tmp_path / "e.json").read_text())["psnr"]


@pytest.fixture
def trained(shared_result: Path) -> float:
    return json.loads((shared_result / "stats" / "val_step0029.json").read_text())["psnr"]


@pytest.mark.parametrize("frame", [(), ("--frame", "training"), ("--frame", "capture")])
def test_an_export_measures_as_its_run_whatever_its_frame(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, trained: float, frame: tuple[str, ...]
) -> None:
    ply = tmp_path / "s.ply"
    assert pop("export", shared_result, "--out", ply, *frame).status == 0
    assert psnr(pop, tmp_path, ply, "--capture", shared_capture) == pytest.approx(trained, abs=1e-2)
    # and so does one that was moved into the other frame and back
    there = tmp_path / "t.ply"
    for way in ("capture", "training"):
        assert pop("export", ply, "--out", there, "--frame", way, "--overwrite").status == 0
        found = frame_of(there)
        assert found is not None
        assert found.name == way
        assert psnr(pop, tmp_path, there, "--capture", shared_capture) == pytest.approx(trained, abs=1e-2)


def test_a_run_s_own_ply_says_its_frame_and_the_layout_of_inria_too(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, trained: float
) -> None:
    found = frame_of(shared_result / "ply" / "point_cloud_29.ply")
    assert found is not None
    assert found.name == "training"
    record = json.loads((shared_result / "capture.json").read_text())
    np.testing.assert_array_equal(np.array(found.transform), np.array(record["world_transform"]))
    assert pop("export", shared_result, "--out", tmp_path / "i", "--layout", "inria").status == 0
    (ply,) = (tmp_path / "i").rglob("*.ply")
    assert psnr(pop, tmp_path, ply, "--capture", shared_capture) == pytest.approx(trained, abs=1e-2)


def test_a_ply_that_says_nothing_is_taken_to_be_in_the_capture_s_frame_with_a_note(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, trained: float
) -> None:
    assert pop("export", shared_result, "--out", tmp_path / "o.ply").status == 0
    save_ply(tmp_path / "s.ply", load_ply(tmp_path / "o.ply"))
    outcome = pop.done("eval", tmp_path / "s.ply", "--capture", shared_capture, "--json", tmp_path / "e.json")
    assert json.loads((tmp_path / "e.json").read_text())["psnr"] == pytest.approx(trained, abs=1e-2)
    assert "s.ply: says nothing of its world, and is taken to be in the capture's own" in outcome.err
    assert "--training-frame" in outcome.err
    # an explicit frame brings no note
    psnr(pop, tmp_path, tmp_path / "s.ply", "--capture", shared_capture, "--own-frame")
    # what is not known is not made up
    assert pop("export", tmp_path / "s.ply", "--out", tmp_path / "t.ply").status == 0
    assert frame_of(tmp_path / "t.ply") is None


def test_a_ply_of_a_trainer_that_moves_the_world_is_read_as_the_command_says(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, trained: float
) -> None:
    save_ply(tmp_path / "s.ply", load_ply(shared_result / "ply" / "point_cloud_29.ply"))
    about = ("--capture", shared_capture, "--training-frame")
    assert psnr(pop, tmp_path, tmp_path / "s.ply", *about) == pytest.approx(trained, abs=1e-2)
    pop.done("export", tmp_path / "s.ply", "--out", tmp_path / "t.ply", *about, "--frame", "capture")
    assert psnr(pop, tmp_path, tmp_path / "t.ply", "--capture", shared_capture) == pytest.approx(trained, abs=1e-2)
    says(pop("eval", tmp_path / "s.ply", *about, "--own-frame"), "--own-frame and --training-frame exclude each other")


def test_another_capture_than_the_one_trained_on_is_refused(
    pop: Pop, shared_result: Path, capture: Path, tmp_path: Path
) -> None:
    (capture / "images" / "view_003.png").unlink()
    ply = shared_result / "ply" / "point_cloud_29.ply"
    lone = tmp_path / "s.ply"
    lone.write_bytes(ply.read_bytes())
    says(pop("eval", lone, "--capture", capture, "--missing", "skip"), "normalizes otherwise than toy")


def test_the_comment_reads_back_to_the_last_bit(tmp_path: Path) -> None:
    rows = tuple(map(tuple, np.random.default_rng(0).normal(0.0, 1e3, (4, 4)).tolist()))
    for frame in (Frame("capture"), Frame("training", rows), None):
        save_ply(tmp_path / "a.ply", make(3)[0], frame=frame)
        assert frame_of(tmp_path / "a.ply") == frame


@pytest.mark.parametrize(
    "words", ["", "world", "capture 1 2", "training nan" + 15 * " 0", "training " + 16 * "x ", "training" + 16 * " 1"]
)
def test_a_damaged_comment_is_named(tmp_path: Path, words: str) -> None:
    save_ply(tmp_path / "a.ply", make(3)[0], frame=Frame("capture"))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"pop-frame: capture", f"pop-frame: {words}".encode()))
    assert_one_line(lambda: frame_of(tmp_path / "a.ply"), "a.ply", "pop-frame:", "damaged")


def test_a_name_that_promises_another_format_holds_that_format(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    assert pop("export", shared_result, "--out", tmp_path / "a.compressed.ply").status == 0
    header = (tmp_path / "a.compressed.ply").read_bytes().partition(b"end_header")[0]
    assert b"packed_position" in header
    assert b"f_dc_0" not in header


# Every file that `pop` writes shows in `pop eval`, `render` and `compare` what the run showed that it is of.

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
def turned(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """The tiny capture in another world."""

    def make(folder: Path) -> None:
        sparse = Path(shutil.copytree(shared_capture, folder / "toy")) / "sparse" / "0"
        model = pycolmap.Reconstruction(sparse)
        rotation = pycolmap.Rotation3d(Rotation.from_rotvec([1.1, -0.7, 2.0]).as_matrix())
        model.transform(pycolmap.Sim3d(3.5, rotation, np.array([40.0, -25.0, 60.0])))
        model.write(sparse)

    return made_once("turned", make) / "toy"


@pytest.fixture(scope="module")
def run(turned: Path, made_once: Callable[..., Path]) -> Path:
    """A result on it, which tests only read."""

    def make(folder: Path) -> None:
        words = ("--out", str(folder / "toy_pop"), *TRAIN, "--steps-scaler", "0.01", "--export", "splat", "sog")
        assert main(["train", str(turned), *words]) == 0

    return made_once("run", make) / "toy_pop"


def stats(run: Path) -> dict[str, Any]:
    """What the run states: its PSNR, and under "encodings" that of every format."""
    path = max((run / "stats").glob("val_step*.json"))
    return json.loads(path.read_text())


def assert_shows_the_same(pop: Pop, file: Path, turned: Path, run: Path, name: str, *words: str) -> None:
    """Hold `eval`, `render` and `compare` of a file to the PSNR of its run."""
    own, folder = stats(run)["psnr"], file.parent / "views"
    about = ("--capture", turned, *words)
    outcome = pop.done("eval", file, *about, "--json", file.parent / "e.json")
    assert ("says nothing of its world" in outcome.err) == (name == "splat" and not words)
    measured = json.loads((file.parent / "e.json").read_text())["psnr"]
    assert measured == pytest.approx(own, abs=LOSES[name])
    outcome = pop.done("render", file, *about, "--out", folder, "--overwrite")
    listing = json.loads((folder / "renders.json").read_text())["renders"]
    psnrs = [shown_psnr(folder / entry["file"], turned / "images" / entry["view"]) for entry in listing]
    # pictures are rounded to bytes
    assert float(np.mean(psnrs)) == pytest.approx(measured, abs=0.02)
    outcome = pop.done("compare", run, file, *about, "--markdown")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in outcome.out.splitlines()]
    column = rows[0].index("PSNR")
    assert [row[column] for row in rows[2:]] == [f"{own:.2f}", f"{measured:.2f}"]
    assert rows[3][rows[0].index("method")] == file.name


def shown_psnr(render: Path, photograph: Path) -> float:
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
    outcome = pop.done("export", run, "--to", name, *frame)
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
    pop.done("convert", "a.ply", default_name("b", name), "--to", name)
    assert_shows_the_same(pop, tmp_path / default_name("b", name), turned, run, name)


@pytest.mark.parametrize("name", ["splat", "sog"])
def test_what_a_training_exports_shows_what_the_training_stated(pop: Pop, run: Path, tmp_path: Path, name: str) -> None:
    # in the result's folder it has a run, which is in another frame
    pop.done("eval", run / "export" / f"toy_pop.{name}", "--json", tmp_path / "e.json")
    measured = json.loads((tmp_path / "e.json").read_text())["psnr"]
    (stated,) = (entry["psnr"] for entry in stats(run)["encodings"] if entry["format"] == name)
    assert measured == pytest.approx(stated, abs=1e-3)
    assert measured == pytest.approx(stats(run)["psnr"], abs=LOSES[name])
