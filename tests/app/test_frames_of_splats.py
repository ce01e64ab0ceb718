"""A PLY says which world it is in, so that what is exported measures as what was trained, without being told."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from pop_fast.io.ply import Frame, frame_of, load_ply, save_ply
from tests.app.captures import assert_one_line
from tests.app.conftest import Pop
from tests.app.populations import make


def psnr(pop: Pop, tmp_path: Path, *words: object) -> float:
    outcome = pop("eval", *words, "--json", tmp_path / "e.json")
    assert outcome.status == 0, outcome.err
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
    outcome = pop("eval", tmp_path / "s.ply", "--capture", shared_capture, "--json", tmp_path / "e.json")
    assert outcome.status == 0
    assert json.loads((tmp_path / "e.json").read_text())["psnr"] == pytest.approx(trained, abs=1e-2)
    assert "s.ply: says nothing of its world, and is taken to be in the capture's own" in outcome.err
    assert "--training-frame" in outcome.err
    # who says it is told nothing
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
    outcome = pop("export", tmp_path / "s.ply", "--out", tmp_path / "t.ply", *about, "--frame", "capture")
    assert outcome.status == 0, outcome.err
    assert psnr(pop, tmp_path, tmp_path / "t.ply", "--capture", shared_capture) == pytest.approx(trained, abs=1e-2)
    outcome = pop("eval", tmp_path / "s.ply", *about, "--own-frame")
    assert outcome.status == 2
    assert "--own-frame and --training-frame exclude each other" in outcome.err


def test_another_capture_than_the_one_trained_on_is_refused(
    pop: Pop, shared_result: Path, capture: Path, tmp_path: Path
) -> None:
    (capture / "images" / "view_003.png").unlink()
    ply = shared_result / "ply" / "point_cloud_29.ply"
    lone = tmp_path / "s.ply"
    lone.write_bytes(ply.read_bytes())
    outcome = pop("eval", lone, "--capture", capture, "--missing", "skip")
    assert outcome.status == 2
    assert "normalizes otherwise than toy" in outcome.err


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
