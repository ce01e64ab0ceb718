"""Bare folders of photographs: what is read, what is written where, and what is never removed.

The search for cameras itself is replaced here by a model made beforehand; `test_photos.py` runs it.
"""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from pop_fast.data import load_capture, run_sfm, sfm
from pop_fast.io import images
from tests.app.captures import assert_one_line, make_model, photograph, ring, write_photograph
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents


@pytest.fixture(autouse=True)
def _cameras_are_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(job: Any, *_: Any) -> Any:
        return make_model(job.names[:3], ring(len(job.names[:3])))

    monkeypatch.setattr(sfm, "_find_cameras", find)


def fill(folder: Path, names: tuple[str, ...] = ("0.png", "1.png", "2.png")) -> Path:
    for i, name in enumerate(names):
        write_photograph(folder / name, photograph(i))
    return folder


def test_photographs_are_never_replaced_by_the_capture_that_is_made_of_them(tmp_path: Path) -> None:
    shoot = tmp_path / "shoot"
    fill(shoot / "jpgs")
    (shoot / "raw").mkdir()
    (shoot / "raw" / "a.dng").write_bytes(b"raw")
    (shoot / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    for overwrite in (False, True):
        for out in (shoot, tmp_path, shoot / "raw" / ".."):
            assert_one_line(
                lambda out=out, o=overwrite: run_sfm(shoot / "jpgs", out, overwrite=o), str(out), "jpgs", "--out"
            )
    assert contents(tmp_path) == before


@pytest.mark.parametrize("mine", ["notes.txt", "raw/a.dng", "images/more.png", "sparse/0/project.ini", "images/0.png"])
def test_only_what_was_written_before_is_replaced(tmp_path: Path, mine: str) -> None:
    fill(tmp_path / "in")
    out = tmp_path / "out"
    run_sfm(tmp_path / "in", out)
    # another result of the same photographs, and one of fewer, take its place
    run_sfm(tmp_path / "in", out, overwrite=True)
    (tmp_path / "in" / "2.png").unlink()
    run_sfm(tmp_path / "in", out, overwrite=True)
    assert sorted(path.name for path in (out / "images").iterdir()) == ["0.png", "1.png"]
    (out / mine).parent.mkdir(exist_ok=True)
    (out / mine).write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(tmp_path / "in", out, overwrite=True), str(out), mine, "not replaced")
    assert contents(tmp_path) == before


def test_a_model_that_somebody_else_made_beside_the_photographs_is_kept(tmp_path: Path) -> None:
    fill(tmp_path / "images")
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (tmp_path / "sparse" / "0" / "cameras.bin").write_bytes(b"mine")
    before = contents(tmp_path)
    assert_one_line(lambda: run_sfm(tmp_path / "images", overwrite=True), "sparse", "0/cameras.bin", "did not write")
    assert contents(tmp_path) == before
    shutil.rmtree(tmp_path / "sparse")
    for overwrite in (False, True):
        assert run_sfm(tmp_path / "images", overwrite=overwrite).capture == tmp_path.resolve()


def test_a_capture_made_inside_the_folder_of_photographs_is_no_photograph_the_next_time(tmp_path: Path) -> None:
    fill(tmp_path)
    for overwrite in (False, True):
        assert run_sfm(tmp_path, tmp_path / "scene", overwrite=overwrite).photographs == 3


def test_a_folder_that_is_itself_called_images_is_loaded(tmp_path: Path) -> None:
    root = fill(tmp_path / "images")
    (tmp_path / "notes.txt").write_text("mine")
    assert len(load_capture(root, sfm=True).views) == 3
    assert len(load_capture(root).views) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["images", "notes.txt"]


def test_photographs_in_subfolders_alone_are_loaded(tmp_path: Path) -> None:
    fill(tmp_path, ("left cam/0.png", "left cam/1.png", "right/0.png"))
    capture = load_capture(tmp_path, sfm=True)
    assert [view.name for view in capture.views] == ["left cam/0.png", "left cam/1.png", "right/0.png"]
    assert capture.notes == ()


def test_photographs_that_could_not_be_placed_are_told(tmp_path: Path) -> None:
    fill(tmp_path, tuple(f"{i}.png" for i in range(5)))
    (note,) = load_capture(tmp_path, sfm=True).notes
    assert note.startswith("3 of 5 photographs in")
    assert note.endswith("has no camera for 3.png, 4.png")


def test_photographs_in_a_format_that_is_not_read_are_named_with_the_way_to_convert_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    for name in ("a.HEIC", "b.HEIC", "c.dng"):
        (tmp_path / name).write_bytes(b"no JPEG")
    words = ("3 files are HEIC", "pip install pillow-heif, or convert them to JPEG", "mogrify -format jpg *.HEIC")
    assert_one_line(lambda: load_capture(tmp_path, sfm=True), "has no photographs", *words)
    assert_one_line(lambda: run_sfm(tmp_path), "has 0 photograph(s)", *words)


def test_the_search_for_cameras_is_told_apart_from_loading(pop: Pop, tmp_path: Path, monkeypatch: Any) -> None:
    fill(tmp_path / "photos", tuple(f"{i}.png" for i in range(4)))
    searched = sfm._find_cameras

    def slowly(*given: Any) -> Any:
        time.sleep(1.0)
        return searched(*given)

    monkeypatch.setattr(sfm, "_find_cameras", slowly)
    done = pop("train", tmp_path / "photos", "--out", tmp_path / "out", "--max-steps", "2", *TRAIN, "--skip-sizes")
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    assert lines[0] in ("cameras found in 1 s", "cameras found in 2 s", "cameras found in 3 s")
    assert any("the model has no camera for 3.png" in line for line in lines)
    stats = json.loads((tmp_path / "out" / "stats" / "val_step0001.json").read_text())
    assert stats["seconds_sfm"] >= 1.0
    assert f"loading {stats['seconds_loading']:.0f} s, finding cameras {stats['seconds_sfm']:.0f} s" in done.out
