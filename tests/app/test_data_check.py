"""`pop data check`: what it says is what training will find, and what it says of photographs alone."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.faults.corpus import HERE
from pop_fast.data import load_capture, sfm
from pop_fast.demo.scene import make_scene
from pop_fast.demo.tracer import render_view
from pop_fast.io import images
from tests.app.captures import colmap_capture, look_at, photograph, write_photograph
from tests.app.conftest import Pop

K = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    """Photographs of the demo scene along a walk."""
    scene = make_scene(0)
    places = [(4.0 * np.cos(a), 4.0 * np.sin(a), 1.5) for a in np.linspace(0.0, 1.6, 8)]
    return [render_view(scene, look_at(place, (0.0, 0.0, 0.4)), K, 160, 120) for place in places]


@pytest.fixture
def bare(tmp_path: Path, pictures: list[np.ndarray]) -> Path:
    folder = tmp_path / "photos"
    for i, picture in enumerate(pictures):
        write_photograph(folder / f"{i}.png", picture)
    return folder


def test_a_capture_made_in_place_is_ready_as_training_finds_it(pop: Pop, tmp_path: Path) -> None:
    root = colmap_capture(tmp_path / "scene")
    for path in (root / "images").iterdir():
        path.rename(root / path.name)
    (root / "images").rmdir()
    assert len(load_capture(root).views) == 4
    outcome = pop("data", "check", root)
    assert outcome.status == 0, outcome.out
    assert "absent" not in outcome.out
    assert "0 MB at factor 1" in outcome.out
    assert "ready to train" in outcome.out


def test_the_folder_of_the_photographs_can_be_named(pop: Pop, tmp_path: Path) -> None:
    root = colmap_capture(tmp_path / "scene")
    (root / "images").rename(root / "small")
    assert pop("data", "check", root, "--images", "small").status == 0
    assert pop("data", "check", root).status == 2


def test_photographs_alone_are_looked_over(pop: Pop, bare: Path) -> None:
    outcome = pop("data", "check", bare)
    assert outcome.status == 0, outcome.err
    for words in ("none yet, 8 photographs", "pop train finds", "8 of 160x120 px", "8 are few", "ready to train"):
        assert words in outcome.out
    for about in ("blur", "exposure", "duplicates"):
        assert f"LOOK  {about}" not in outcome.out


def test_one_photograph_is_too_few(pop: Pop, tmp_path: Path) -> None:
    write_photograph(tmp_path / "0.png", photograph(0))
    outcome = pop("data", "check", tmp_path)
    assert outcome.status == 1
    assert "none yet, 1 photograph: a scene needs two or more" in outcome.out
    assert "1 is few" in outcome.out


def test_a_blurred_a_dark_and_a_copied_photograph_are_named(pop: Pop, bare: Path, pictures: list[np.ndarray]) -> None:
    write_photograph(bare / "2.png", cv2.GaussianBlur(pictures[2], (0, 0), 3.0))
    write_photograph(bare / "4.png", np.zeros_like(pictures[4]))
    shutil.copy(bare / "6.png", bare / "6 copy.png")
    # the same picture, written otherwise
    assert cv2.imwrite(str(bare / "7 again.jpg"), cv2.imread(str(bare / "7.png")), [cv2.IMWRITE_JPEG_QUALITY, 95])
    lines = pop("data", "check", bare).out.splitlines()
    (blur,) = [line for line in lines if "far less sharp" in line]
    assert "2.png" in blur
    assert "1 is over a quarter pure black, first 4.png" in "\n".join(lines)
    assert any("2 are the same file more than once" in line and "6 copy.png" in line for line in lines)
    assert any("1 pair looks the same" in line and "7 again.jpg" in line for line in lines)


def test_exposures_and_lenses_that_differ_are_told(pop: Pop, tmp_path: Path, pictures: list[np.ndarray]) -> None:
    for i, picture in enumerate(pictures):
        exif = Image.Exif()
        exif[0x10F], exif[0x110] = "Maker", "Maker X"
        exif[0x8769] = {0x829A: IFDRational(1, 100 * 2 ** (i % 3)), 0x8827: 100, 0x920A: IFDRational(4 + i % 2, 1)}
        Image.fromarray(picture).save(tmp_path / f"{i}.jpg", exif=exif, quality=95)
    out = pop("data", "check", tmp_path).out
    assert "8 x Maker X; focal length 4 mm, 5 mm: several lenses" in out
    assert "exposures differ by 2.0 stops; lock the exposure, or train with --exposure" in out
    assert "no focal length" not in out
    write_photograph(tmp_path / "edited.jpg", photograph(1, 160, 120))
    assert (
        "1 has no focal length, first edited.jpg; where photographs were edited" in pop("data", "check", tmp_path).out
    )


def test_what_is_not_read_is_mentioned_among_what_is(pop: Pop, bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    (bare / "a.HEIC").write_bytes(b"no JPEG")
    (bare / "b.MOV").write_bytes(b"no JPEG")
    outcome = pop("data", "check", bare)
    assert outcome.status == 0
    for words in ("1 file is HEIC", "mogrify -format jpg *.HEIC", "1 file is a video", "pop frames b.MOV"):
        assert words in outcome.out


def test_a_folder_of_nothing_else_says_how_to_convert_it(pop: Pop, tmp_path: Path) -> None:
    (tmp_path / "clip.mp4").write_bytes(b"no JPEG")
    outcome = pop("data", "check", tmp_path)
    assert outcome.status == 2
    assert "1 file is a video" in outcome.err


def test_a_damaged_photograph_stands_against_training(pop: Pop, bare: Path) -> None:
    (bare / "3.png").write_bytes((bare / "3.png").read_bytes()[:-40])
    outcome = pop("data", "check", bare)
    assert outcome.status == 1
    assert "3.png: the PNG file is truncated" in outcome.out


def test_tracks_that_colmap_refuses_are_told_with_the_models_folder(pop: Pop, tmp_path: Path) -> None:
    shutil.copytree(HERE / "colmap", tmp_path / "scene")
    outcome = pop("data", "check", tmp_path / "scene")
    assert outcome.err == ""
    (line,) = [line for line in outcome.out.splitlines() if " reprojection " in line]
    assert line.startswith("LOOK")
    assert f"{tmp_path / 'scene' / 'sparse' / '0'}: COLMAP cannot read its tracks" in line
    assert line.endswith("training does without its tracks; write the model again to have them")
    assert pop("data", "check", HERE / "tracked").out.count("mean error") == 1


def noise(seed: int) -> np.ndarray:
    """A photograph with hundreds of features and nothing in common with another."""
    coarse = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    return cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)


HOPELESS = {
    "black": (lambda i: np.zeros((120, 160, 3), np.uint8), "4 of 4 photographs are of one colour all over"),
    "unrelated": (noise, "no two of the 4 photographs show the same thing"),
}


@pytest.mark.parametrize("what", HOPELESS)
def test_photographs_that_no_cameras_can_be_found_for_are_refused_by_check_and_training_alike(
    pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    make, words = HOPELESS[what]
    for i in range(4):
        write_photograph(tmp_path / "photos" / f"{i}.png", make(i))
    checked = pop("data", "check", tmp_path / "photos")
    assert checked.status == 1
    assert words in checked.out
    assert "1 problem stands against training" in checked.out
    monkeypatch.setattr(sfm, "find_cameras", never)
    trained = pop("train", tmp_path / "photos", "--out", tmp_path / "out")
    assert trained.status == 2
    assert words in trained.err
    assert "no cameras could be found" in trained.err


def never(*_: object, **__: object) -> None:
    raise AssertionError("the long work has begun")


def test_photographs_that_overlap_are_not_called_unrelated(pop: Pop, tmp_path: Path) -> None:
    wall = np.random.default_rng(0).integers(0, 256, (60, 240, 3), dtype=np.uint8)
    wall = cv2.resize(wall, (1200, 300), interpolation=cv2.INTER_CUBIC)
    for i in range(3):
        write_photograph(tmp_path / f"{i}.png", wall[:, 300 * i : 300 * i + 500])
    assert pop("data", "check", tmp_path).status == 0


@pytest.mark.parametrize("name", ["walk.mp4", "photos.zip", "gone"])
def test_what_is_no_folder_is_refused_in_the_same_words(pop: Pop, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.endswith("zip"):
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a.jpg", b"")
    elif name.endswith("mp4"):
        path.write_bytes(b"no JPEG")
    checked, trained = pop("data", "check", path), pop("train", path, "--out", tmp_path / "out")
    assert checked.status == trained.status == 2
    assert checked.err == trained.err
    assert {"walk.mp4": "pop frames", "photos.zip": "unpack it", "gone": "no such folder"}[name] in checked.err


def test_sizes_that_differ_are_called_mixed_cameras(pop: Pop, bare: Path, pictures: list[np.ndarray]) -> None:
    assert "mixed cameras" not in pop("data", "check", bare).out
    write_photograph(bare / "3.png", pictures[3][:110])
    write_photograph(bare / "4.png", pictures[4][:100])
    lines = pop("data", "check", bare).out.splitlines()
    assert any(
        line.startswith("LOOK  cameras") and "mixed cameras: the photographs have 3 sizes" in line for line in lines
    )


def test_photographs_without_a_camera_are_named(pop: Pop, tmp_path: Path) -> None:
    root = colmap_capture(tmp_path / "scene")
    for name in ("late.png", "later.png"):
        write_photograph(root / "images" / name, photograph(9))
    note = next(line for line in pop("data", "check", root).out.splitlines() if "has no camera for" in line)
    assert "4 of 6 photographs" in note
    assert note.endswith("late.png, later.png")
    assert load_capture(root).notes[0] in note
