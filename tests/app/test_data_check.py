"""`pop data check`: what it says is what training will find, and what it says of photographs alone."""

from __future__ import annotations

import importlib
import shutil
import struct
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.faults.corpus import HERE
from pop_fast.data import load_capture, sfm
from pop_fast.demo.make import render_view
from pop_fast.demo.scene import make_scene
from pop_fast.io import images
from tests.app.captures import colmap_capture, look_at, photograph, ring, write_model, write_photograph
from tests.app.conftest import Pop
from tests.app.damage import says

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
    outcome = pop.done("data", "check", root)
    assert "absent" not in outcome.out
    assert "0 MB at factor 1" in outcome.out
    assert "ready to train" in outcome.out


def test_the_folder_of_the_photographs_can_be_named(pop: Pop, tmp_path: Path) -> None:
    root = colmap_capture(tmp_path / "scene")
    (root / "images").rename(root / "small")
    assert pop("data", "check", root, "--images", "small").status == 0
    assert pop("data", "check", root).status == 2


def test_photographs_alone_are_looked_over(pop: Pop, bare: Path) -> None:
    outcome = pop.done("data", "check", bare)
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
    outcome = pop.done("data", "check", bare)
    for words in ("1 file is HEIC", "mogrify -format jpg *.HEIC", "1 file is a video", "pop frames b.MOV"):
        assert words in outcome.out


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
    says(pop("train", tmp_path / "photos", "--out", tmp_path / "out"), words, "no cameras could be found")


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
            archive.writestr("../a.jpg", b"")
    elif name.endswith("mp4"):
        path.write_bytes(b"no JPEG")
    checked, trained = pop("data", "check", path), pop("train", path, "--out", tmp_path / "out")
    assert checked.status == trained.status == 2
    assert checked.err == trained.err
    words = {"walk.mp4": "is no video", "photos.zip": "outside of its folder", "gone": "no such folder"}
    assert words[name] in checked.err


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


# `pop doctor` and `pop data check`: what they find, and what they say about it.


def test_a_whole_install_is_found_whole(pop: Pop) -> None:
    outcome = pop.done("doctor")
    for name in ("numpy", "torch", "pycolmap", "opencv-contrib-python-headless", "backend fast", "processor", "memory"):
        assert name in outcome.out
    assert "everything that pop needs is here" in outcome.out


@pytest.mark.parametrize(
    ("missing", "words"),
    [(None, "ok       CUDA build"), ("nvcc", "nvcc was not found; install a CUDA toolkit"), ("cmake", "[cuda-build]")],
)
def test_what_building_the_cuda_extension_lacks_is_said(
    pop: Pop, monkeypatch: pytest.MonkeyPatch, missing: str | None, words: str
) -> None:
    from cuda_ext import build, toolkit

    monkeypatch.setattr(build, "find_nvcc", lambda: None if missing == "nvcc" else "/opt/nvcc")
    monkeypatch.setattr(build, "_program", lambda name: None if name == missing else f"/bin/{name}")
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(toolkit, "nvcc_version", lambda nvcc: (13, 0))
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built")
    outcome = pop.done("doctor")
    line = next(line for line in outcome.out.splitlines() if "CUDA build" in line)
    assert words in line
    backend = next(line for line in outcome.out.splitlines() if "backend cuda" in line)
    assert " ".join(backend.split()) == "- backend cuda the CUDA extension is not built (optional)"


@pytest.mark.parametrize("how", ["absent", "broken"])
def test_a_missing_package_is_named_with_the_way_to_get_it(pop: Pop, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    real = importlib.import_module

    def import_module(name: str, package: str | None = None) -> Any:
        if name == "plyfile":
            raise ImportError("no such module") if how == "absent" else OSError("libxyz.so: cannot open")
        return real(name, package)

    monkeypatch.setattr("pop_fast.cli.doctor.importlib.import_module", import_module)
    if how == "absent":
        monkeypatch.setattr("pop_fast.cli.doctor._installed", lambda name: None if name == "plyfile" else "1.0")
    outcome = pop("doctor")
    assert outcome.status == 1
    line = next(line for line in outcome.out.splitlines() if "plyfile" in line)
    assert line.strip().startswith("MISSING")
    assert "pip install" in line
    assert ("libxyz.so" in line) == (how == "broken")
    assert outcome.out.rstrip().endswith("missing: plyfile")


def check(pop: Pop, folder: Path, status: int) -> list[str]:
    outcome = pop("data", "check", folder)
    assert outcome.status == status, outcome
    return outcome.out.splitlines()


def finding(lines: list[str], mark: str, about: str) -> str:
    """Give the first finding of that mark and topic."""
    return next(line for line in lines if line.split()[:2] == [mark, about])


def test_a_sound_capture_is_ready(pop: Pop, shared_capture: Path) -> None:
    lines = check(pop, shared_capture, 0)
    assert lines[-1] == "ready to train"
    assert "8 views from the COLMAP model in sparse/0" in finding(lines, "ok", "poses")
    assert "8 x PINHOLE 40x32" in finding(lines, "ok", "cameras")
    assert "8 of 40x32 px" in finding(lines, "ok", "photographs")
    assert "mean error" in finding(lines, "ok", "reprojection")
    assert "at factor 4" in finding(lines, "ok", "memory")
    # eight photographs around a still life are far apart
    assert [line.split()[1] for line in lines if line.startswith(("LOOK", "BAD"))] == ["spacing"]


def test_cameras_that_stand_farthest_from_the_nearest_other_are_named(pop: Pop, tmp_path: Path) -> None:
    whole = colmap_capture(tmp_path / "whole", count=36)
    found = finding(check(pop, whole, 0), "ok", "spacing")
    assert "neighbours 9.5 degrees apart as the subject sees them (median)" in found
    # every fourth of these cameras, and one more beside the first
    numbers = [0, 1, *range(4, 36, 4)]
    names = [f"{number:02d}.png" for number in numbers]
    write_model(whole / "sparse" / "0", names, ring(36)[numbers])
    found = finding(check(pop, whole, 0), "LOOK", "spacing")
    assert "far; photographs between these would help most: 38 degrees between" in found
    assert "00.png and 01.png" not in found


def test_every_problem_of_a_damaged_capture_is_listed_at_once(pop: Pop, capture: Path) -> None:
    photos = sorted((capture / "images").iterdir())
    photos[1].unlink()
    photos[2].write_bytes(photos[2].read_bytes()[:200])
    cv2.imwrite(str(photos[3]), np.zeros((40, 32, 3), np.uint8))
    cv2.imwrite(str(capture / "images" / "extra.png"), np.zeros((32, 40, 3), np.uint8))
    lines = check(pop, capture, 1)
    text = "\n".join(lines)
    assert "1 of 8 listed are absent, first view_001.png" in text
    assert "view_002.png" in text
    assert "view_003.png is 32x40 px, its camera 40x32: another shape" in text
    assert "1 files in images/ are not listed, first extra.png" in finding(lines, "LOOK", "pairing")
    assert lines[-1] == "3 problems stand against training"


def test_photographs_of_half_the_size_are_fine_and_said_so(pop: Pop, capture: Path) -> None:
    for path in (capture / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (20, 16)))
    lines = check(pop, capture, 0)
    assert "K is scaled to fit" in finding(lines, "ok", "sizes")
    assert lines[-2] == "and 3 more of the same kinds; --all prints them"


def with_exif_orientation(jpeg: bytes, orientation: int) -> bytes:
    """Insert an EXIF segment that holds an orientation alone."""
    tiff = b"II*\0" + struct.pack("<IH", 8, 1) + struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0) + bytes(4)
    body = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


@pytest.mark.parametrize(("orientation", "turned"), [(1, False), (3, True), (6, True)])
def test_exif_orientation_is_pointed_out(pop: Pop, capture: Path, orientation: int, turned: bool) -> None:
    path = capture / "images" / "view_000.png"
    ok, data = cv2.imencode(".jpg", cv2.imread(str(path)))
    assert ok
    path.unlink()
    path.with_suffix(".jpg").write_bytes(with_exif_orientation(data.tobytes(), orientation))
    lines = check(pop, capture, 0)
    found = [line for line in lines if line.split()[:2] == ["LOOK", "EXIF"]]
    assert len(found) == turned
    assert not turned or "1 ask to be rotated, first view_000.png" in found[0]


@pytest.mark.parametrize(("kept", "mark"), [(0.9, "ok"), (0.1, "LOOK")])
def test_masks_that_look_inverted_are_pointed_out(pop: Pop, capture: Path, kept: float, mark: str) -> None:
    (capture / "masks").mkdir()
    mask = np.zeros((32, 40), np.uint8)
    mask[: round(32 * kept)] = 255
    for path in sorted((capture / "images").iterdir())[:-1]:
        cv2.imwrite(str(capture / "masks" / path.name), mask)
    lines = check(pop, capture, 0)
    said = finding(lines, mark, "masks")
    assert "7 masks keep" in said
    assert ("inverted" in said) == (mark == "LOOK")
    assert "1 photographs have none, first view_007.png" in "\n".join(lines)
