"""`pop data check` says what training will find, and what is odd among photographs alone; `pop doctor`."""

from __future__ import annotations

import importlib
import math
import re
import shutil
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.faults.corpus import HERE
from cuda_ext import build, toolkit
from pop_fast.data import Capture, load_capture, sfm
from pop_fast.data.load import list_capture, write_block
from pop_fast.data.photo_quality import GAMMA, UNEVEN, Exposures, exposures, exposures_of, levels_at
from pop_fast.demo import make_demo
from pop_fast.demo.make import render_view
from pop_fast.demo.scene import make_scene
from pop_fast.io import images
from pop_fast.train import TrainConfig
from pop_fast.train.automatic import choose_terms
from tests.app.captures import (
    assert_one_line,
    camera,
    colmap_capture,
    edit_transforms,
    look_at,
    photograph,
    ring,
    transforms_capture,
    write_model,
    write_photograph,
)
from tests.app.conftest import Pop
from tests.app.damage import says

K = np.array([[150.0, 0.0, 80.0], [0.0, 150.0, 60.0], [0.0, 0.0, 1.0]])
Check = Callable[..., list[str]]


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


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return colmap_capture(tmp_path / "scene")


@pytest.fixture
def check(pop: Pop) -> Check:
    """Look a folder over, which ends with the status, and give the lines that are said."""

    def lines(folder: Path, status: int = 0) -> list[str]:
        outcome = pop("data", "check", folder)
        assert (outcome.status, outcome.err) == (status, ""), outcome
        return outcome.out.splitlines()

    return lines


def finding(lines: list[str], mark: str, about: str) -> str:
    return next(line for line in lines if line.split()[:2] == [mark, about])


def said(lines: list[str], *words: str) -> bool:
    return all(word in "\n".join(lines) for word in words)


def test_a_sound_capture_is_ready(check: Check, shared_capture: Path) -> None:
    lines = check(shared_capture)
    assert lines[-1] == "ready to train"
    assert "8 views from the COLMAP model in sparse/0" in finding(lines, "ok", "poses")
    assert "8 x PINHOLE 40x32" in finding(lines, "ok", "cameras")
    assert "8 of 40x32 px" in finding(lines, "ok", "photographs")
    assert "mean error" in finding(lines, "ok", "reprojection")
    assert "at factor 4" in finding(lines, "ok", "memory")
    # eight photographs around a still life are far apart
    assert [line.split()[1] for line in lines if line.startswith(("LOOK", "BAD"))] == ["spacing"]


def test_a_capture_made_in_place_is_ready_as_training_finds_it(check: Check, root: Path) -> None:
    for path in (root / "images").iterdir():
        path.rename(root / path.name)
    (root / "images").rmdir()
    assert len(load_capture(root).views) == 4
    lines = check(root)
    assert not said(lines, "absent")
    assert said(lines, "0 MB at factor 1", "ready to train")


def test_the_folder_of_the_photographs_can_be_named(pop: Pop, root: Path) -> None:
    (root / "images").rename(root / "small")
    assert pop("data", "check", root, "--images", "small").status == 0
    assert pop("data", "check", root).status == 2


def test_cameras_that_stand_farthest_from_the_nearest_other_are_named(check: Check, tmp_path: Path) -> None:
    whole = colmap_capture(tmp_path / "whole", count=36)
    found = finding(check(whole), "ok", "spacing")
    assert "neighbours 9.5 degrees apart as seen from the subject (median)" in found
    # every fourth of these cameras, and one more next to the first
    numbers = [0, 1, *range(4, 36, 4)]
    names = [f"{number:02d}.png" for number in numbers]
    write_model(whole / "sparse" / "0", names, ring(36)[numbers])
    found = finding(check(whole), "LOOK", "spacing")
    assert "far; photographs between these would help most: 38 degrees between" in found
    assert "00.png and 01.png" not in found


def test_every_problem_of_a_damaged_capture_is_listed_at_once(check: Check, capture: Path) -> None:
    photos = sorted((capture / "images").iterdir())
    photos[1].unlink()
    photos[2].write_bytes(photos[2].read_bytes()[:200])
    write_photograph(photos[3], np.zeros((40, 32, 3), np.uint8))
    write_photograph(capture / "images" / "extra.png", np.zeros((32, 40, 3), np.uint8))
    lines = check(capture, 1)
    assert said(lines, "1 of 8 listed are absent, first view_001.png", "view_002.png")
    assert "1 of 8 have another shape than their camera" in finding(lines, "BAD", "sizes")
    assert "first view_003.png is 32x40 px, its camera 40x32" in finding(lines, "BAD", "sizes")
    assert "1 files in images/ are not listed, first extra.png" in finding(lines, "LOOK", "pairing")
    assert lines[-1] == "3 problems to fix before training"


def test_photographs_of_other_sizes_are_fine_and_said_so_in_one_line(check: Check, capture: Path) -> None:
    for i, path in enumerate(sorted((capture / "images").iterdir())[:7]):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (20 * (i + 1), 16 * (i + 1))))
    lines = check(capture)
    assert [line.split(maxsplit=2)[2] for line in lines if line.split()[1] == "sizes"] == [
        "6 of 8 have another size than their camera and the same shape: K is scaled to fit; "
        "first view_000.png is 20x16 px, its camera 40x32"
    ]
    assert "2 of 40x32 px, 1 of 20x16 px, 1 of 60x48 px, 1 of 80x64 px, and 3 of other sizes" in finding(
        lines, "ok", "photographs"
    )
    assert lines[-1] == "ready to train"
    assert not said(lines, "--all prints them")


def test_of_a_kind_only_five_findings_are_printed_unless_all_are_asked_for(pop: Pop, capture: Path) -> None:
    for path in (capture / "images").iterdir():
        path.write_bytes(path.read_bytes()[:200])
    few, every = pop("data", "check", capture), pop("data", "check", capture, "--all")
    assert "--all prints them" in few.out.splitlines()[-2]
    assert (few.out.count("truncated"), every.out.count("truncated")) == (4, 8), every.out


@pytest.mark.parametrize(("orientation", "turned"), [(1, False), (3, True), (6, True)])
def test_exif_orientation_is_pointed_out(check: Check, capture: Path, orientation: int, turned: bool) -> None:
    path, exif = capture / "images" / "view_000.png", Image.Exif()
    exif[0x112] = orientation
    Image.open(path).save(path.with_suffix(".jpg"), exif=exif)
    path.unlink()
    found = [line for line in check(capture) if line.split()[:2] == ["LOOK", "EXIF"]]
    assert len(found) == turned
    assert not turned or "1 ask to be rotated, first view_000.png" in found[0]


@pytest.mark.parametrize(("kept", "mark"), [(0.9, "ok"), (0.1, "LOOK")])
def test_masks_that_look_inverted_are_pointed_out(check: Check, capture: Path, kept: float, mark: str) -> None:
    mask = np.zeros((32, 40), np.uint8)
    mask[: round(32 * kept)] = 255
    for path in sorted((capture / "images").iterdir())[:-1]:
        write_photograph(capture / "masks" / path.name, mask)
    lines = check(capture)
    about = finding(lines, mark, "masks")
    assert "7 masks keep" in about
    assert ("inverted" in about) == (mark == "LOOK")
    assert said(lines, "1 photographs have none, first view_007.png")


def test_what_training_refuses_stands_against_it_in_the_same_words(check: Check, pop: Pop, tmp_path: Path) -> None:
    def masked(name: str, mask: np.ndarray) -> Path:
        root = colmap_capture(tmp_path / name)
        write_photograph(root / "masks" / "00.png", mask)
        return root

    folded = [camera("SIMPLE_RADIAL", (2.0, 20.0, 15.0, -0.9)), *(camera() for _ in range(3))]
    one_place = colmap_capture(tmp_path / "one place")
    write_model(one_place / "sparse" / "0", [f"{i:02d}.png" for i in range(4)], ring(4)[[0, 0, 0, 0]])
    for root, mark in (
        (masked("of another shape", np.full((30, 20), 255, np.uint8)), "masks"),
        (masked("hides everything", np.zeros((30, 40), np.uint8)), "masks"),
        (colmap_capture(tmp_path / "folded", cameras=folded), "cameras"),
        (one_place, "poses"),
    ):
        message = assert_one_line(lambda root=root: load_capture(root))
        problem = finding(check(root, 1), "BAD", mark).split(maxsplit=2)[2]
        # a check names a photograph by its name, and its folder not at all
        assert message.endswith(problem.removeprefix("00.png: ")), (message, problem)


def test_what_of_a_list_is_unused_and_photographs_that_cannot_be_measured_are_told(check: Check, pop: Pop, root: Path):
    transforms_capture(root)
    assert "transforms.json is left unused: --source transforms" in finding(check(root), "LOOK", "poses")
    outcome = pop("data", "check", root, "--source", "transforms")
    assert "4 views from the transforms.json" in outcome.out
    assert "unused" not in outcome.out
    edit_transforms(root, lambda listing: listing["frames"].append({**listing["frames"][0], "file_path": "images/00"}))
    outcome = pop("data", "check", root, "--source", "transforms")
    assert outcome.status == 1
    assert "images/00 and images/00.png are one photograph" in outcome.out
    for name in ("00.png", "01.png"):
        write_photograph(root / "images" / name, photograph(0, 15, 10 + int(name == "01.png")))
    assert "1 of 4 are smaller than SSIM's window of 11x11 px, first 00.png" in finding(check(root, 1), "BAD", "sizes")


def test_points_are_held_against_cameras_of_which_only_the_field_of_view_is_known(check: Check, tmp_path: Path) -> None:
    root = transforms_capture(tmp_path, camera_angle_x=1.0, **dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy")))
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    (root / "points3D.ply").write_text(f"{head}end_header\n0 0 0\n0 0 99\n")
    assert finding(check(root), "ok", "points").endswith("2; a view sees 50 % of them on average")


def test_lists_that_leave_no_view_and_views_that_see_nothing_together_stand_against_training(check, tmp_path) -> None:
    root = transforms_capture(tmp_path, test_filenames=["images/00.png"])
    assert finding(check(root), "ok", "split").endswith("3 to train on, 1 of 4 held out by its own lists")
    edit_transforms(root, lambda listing: listing.update(test_filenames=[f["file_path"] for f in listing["frames"]]))
    assert "its own lists hold all out" in finding(check(root, 1), "BAD", "split")

    def turn_away(listing: dict[str, Any]) -> None:
        del listing["test_filenames"]
        for frame in listing["frames"]:
            frame["transform_matrix"] = (frame["transform_matrix"] @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist()

    edit_transforms(root, turn_away)
    message = assert_one_line(lambda: load_capture(root), "correct the poses, or add points")
    assert message.endswith(finding(check(root, 1), "BAD", "points").split(maxsplit=2)[2])


def test_of_a_block_the_whole_capture_is_looked_over(check: Check, root: Path, tmp_path: Path) -> None:
    listing = list_capture(root)
    shots = [replace(shot, split="train") for shot in listing.shots[:3]]
    write_block(tmp_path, replace(listing, shots=shots, transform=np.eye(4)))
    assert check(tmp_path)[0].endswith(f"a block of {root}")
    assert check(tmp_path)[1:] == check(root)


def test_a_capture_of_pinholes_and_one_with_a_strip_are_looked_over_without_pycolmap(
    check: Check, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert "not computed: pycolmap" in finding(check(root), "LOOK", "reprojection")
    write_photograph(root / "images" / "panorama.png", np.zeros((2, 4000, 3), np.uint8))
    for path in (root / "sparse" / "0").iterdir():
        path.unlink()
    assert "1 of 4000x2 px" in finding(check(root), "ok", "photographs")


def test_photographs_without_a_camera_are_named(check: Check, root: Path) -> None:
    for name in ("late.png", "later.png"):
        write_photograph(root / "images" / name, photograph(9))
    note = next(line for line in check(root) if "has no camera for" in line)
    assert "4 of 6 photographs" in note
    assert note.endswith("late.png, later.png")
    assert load_capture(root).notes[0] in note


def test_tracks_that_colmap_refuses_are_told_with_the_models_folder(
    pop: Pop, shared_capture: Path, tmp_path: Path
) -> None:
    shutil.copytree(HERE / "colmap", tmp_path / "scene")
    outcome = pop("data", "check", tmp_path / "scene")
    assert outcome.err == ""
    (line,) = [line for line in outcome.out.splitlines() if " reprojection " in line]
    assert line.startswith("LOOK")
    assert f"{tmp_path / 'scene' / 'sparse' / '0'}: COLMAP cannot read its tracks" in line
    assert line.endswith("training takes them as they stand; write the model again to have it measured")
    assert pop("data", "check", HERE / "tracked").out.count("mean error") == 1
    # a copy without its frames holds the same tracks
    copy = Path(shutil.copytree(shared_capture, tmp_path / "copy"))
    (copy / "sparse" / "0" / "frames.bin").unlink()
    assert "COLMAP cannot read its tracks" in pop("data", "check", copy).out
    for ours, theirs in zip(load_capture(copy).views, load_capture(shared_capture).views, strict=True):
        assert len(ours.seen)
        assert np.array_equal(ours.seen, theirs.seen)


def test_points_behind_cameras_that_saw_them_are_counted(check: Check, shared_capture: Path, tmp_path: Path) -> None:
    root = tmp_path / "turned"
    shutil.copytree(shared_capture, root)
    model = pycolmap.Reconstruction(root / "sparse" / "0")
    image = model.images[min(model.images)]
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.diag([-1.0, 1.0, -1.0])), np.zeros(3))
    image.frame.rig_from_world = turn * image.frame.rig_from_world
    model.write(root / "sparse" / "0")
    line = finding(check(root), "LOOK", "reprojection")
    assert line.endswith("points lie behind a camera that saw them: are these poses right?")


def test_photographs_alone_are_looked_over(check: Check, bare: Path, tmp_path: Path) -> None:
    lines = check(bare)
    assert said(lines, "none yet, 8 photographs", "pop train finds", "8 of 160x120 px", "8 are few", "ready to train")
    for about in ("LOOK  blur", "LOOK  exposure", "LOOK  duplicates", "mixed cameras"):
        assert not said(lines, about)
    write_photograph(tmp_path / "one" / "0.png", photograph(0))
    alone = check(tmp_path / "one", 1)
    assert said(alone, "none yet, 1 photograph: a scene needs two or more")
    assert not said(alone, "few")


def test_what_is_odd_among_photographs_is_named(check: Check, bare: Path, pictures: list[np.ndarray]) -> None:
    write_photograph(bare / "2.png", cv2.GaussianBlur(pictures[2], (0, 0), 3.0))
    write_photograph(bare / "4.png", np.zeros_like(pictures[4]))
    shutil.copy(bare / "6.png", bare / "6 copy.png")
    # the same picture, written otherwise
    assert cv2.imwrite(str(bare / "7 again.jpg"), cv2.imread(str(bare / "7.png")), [cv2.IMWRITE_JPEG_QUALITY, 95])
    lines = check(bare)
    (blur,) = [line for line in lines if "far less sharp" in line]
    assert "2.png" in blur
    assert said(lines, "1 is over a quarter pure black, first 4.png")
    assert any("2 are the same file more than once" in line and "6 copy.png" in line for line in lines)
    assert any("1 pair looks the same" in line and "7 again.jpg" in line for line in lines)
    write_photograph(bare / "3.png", pictures[3][:110])
    write_photograph(bare / "5.png", pictures[5][:100])
    assert "mixed cameras: the photographs have 3 sizes" in finding(check(bare), "LOOK", "cameras")


def test_what_is_transparent_is_not_called_black(check: Check, tmp_path: Path, pictures: list[np.ndarray]) -> None:
    for i, picture in enumerate(pictures):
        alpha = np.zeros((*picture.shape[:2], 1), np.uint8)
        alpha[40:80, 60:100] = 255
        Image.fromarray(np.concatenate([picture * (alpha > 0), alpha], axis=2)).save(tmp_path / f"{i}.png")
    levels = [picture[40:80, 60:100].mean() for picture in pictures]
    assert not said(check(tmp_path), "pure black")
    low, high = map(int, re.findall(r"brightness (\d+) to (\d+)", finding(check(tmp_path), "ok", "exposure"))[0])
    # gray weighs the channels otherwise
    assert abs(low - min(levels)) < 15
    assert abs(high - max(levels)) < 15


def test_exposures_and_lenses_that_differ_are_told(check: Check, tmp_path: Path, pictures: list[np.ndarray]) -> None:
    for i, picture in enumerate(pictures):
        exif = Image.Exif()
        exif[0x10F], exif[0x110] = "Maker", "Maker X"
        exif[0x8769] = {0x829A: IFDRational(1, 100 * 2 ** (i % 3)), 0x8827: 100, 0x920A: IFDRational(4 + i % 2, 1)}
        Image.fromarray(picture).save(tmp_path / f"{i}.jpg", exif=exif, quality=95)
    lines = check(tmp_path)
    assert said(lines, "8 x Maker X; focal length 4 mm, 5 mm: several lenses")
    assert said(lines, "mixed cameras: the photographs are of 2 cameras or focal lengths by their EXIF")
    assert said(lines, "exposures differ by 2.0 stops; lock the exposure, or train with --exposure")
    assert not said(lines, "no focal length")
    write_photograph(tmp_path / "edited.jpg", photograph(1, 160, 120))
    assert said(check(tmp_path), "1 has no focal length, first edited.jpg; where photographs were edited")


def test_what_is_not_read_is_mentioned_and_a_damaged_photograph_stands_against_training(check, bare, monkeypatch):
    monkeypatch.setattr(images, "can_read_heif", lambda: False)
    for name in ("a.HEIC", "b.MOV"):
        (bare / name).write_bytes(b"no JPEG")
    words = ("1 file is HEIC", "mogrify -format jpg *.HEIC", "1 file is a video", "pop frames b.MOV")
    assert said(check(bare), *words)
    (bare / "3.png").write_bytes((bare / "3.png").read_bytes()[:-40])
    assert said(check(bare, 1), "3.png: the PNG file is truncated")


def noise(seed: int) -> np.ndarray:
    """A photograph with hundreds of features and nothing in common with another."""
    coarse = np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    return cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)


HOPELESS = {
    "black": (lambda i: np.zeros((120, 160, 3), np.uint8), "4 of 4 photographs are of one colour all over"),
    "copies": (lambda i: noise(0), "all 4 photographs are the same file"),
    "unrelated": (noise, "no two of the 4 photographs show the same thing"),
}


@pytest.mark.parametrize("what", HOPELESS)
def test_photographs_that_no_cameras_can_be_found_for_are_refused_by_check_and_training_alike(
    pop, check, tmp_path, monkeypatch, what
):
    make, words = HOPELESS[what]
    for i in range(4):
        write_photograph(tmp_path / "photos" / f"{i}.png", make(i))
    assert said(check(tmp_path / "photos", 1), words, "1 problem to fix before training")
    monkeypatch.setattr(sfm, "find_cameras", lambda *_, **__: pytest.fail("the long work has begun"))
    says(pop("train", tmp_path / "photos", "--out", tmp_path / "out"), words, "no cameras could be found")


def test_photographs_that_overlap_are_not_called_unrelated(check: Check, tmp_path: Path) -> None:
    wall = np.random.default_rng(0).integers(0, 256, (60, 240, 3), dtype=np.uint8)
    wall = cv2.resize(wall, (1200, 300), interpolation=cv2.INTER_CUBIC)
    for i in range(3):
        write_photograph(tmp_path / f"{i}.png", wall[:, 300 * i : 300 * i + 500])
    check(tmp_path)


WRONG = {"walk.mp4": "is not a video", "photos.zip": "outside of its folder", "gone": "no such folder"}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_folder_is_refused_in_the_same_words(pop: Pop, tmp_path: Path, name: str) -> None:
    (tmp_path / "walk.mp4").write_bytes(b"no JPEG")
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        archive.writestr("../a.jpg", b"")
    path = tmp_path / name
    checked, trained = pop("data", "check", path), pop("train", path, "--out", tmp_path / "out")
    assert checked.status == trained.status == 2
    assert checked.err == trained.err
    assert WRONG[name] in checked.err


# Exposures told by the points that photographs share: measured, chosen by, and told before training.

N_VIEWS, N_POINTS = 30, 400


def test_a_level_is_stops_under_white_and_nothing_at_the_ends_of_the_scale() -> None:
    image = np.full((40, 60, 3), 128, np.uint8)
    image[:, 40:] = 255
    image[20:, :20] = 5
    places = np.array([[10.5, 5.5], [55.0, 5.0], [5.0, 35.0], [-0.1, 5.0], [60.0, 5.0], [np.nan, 5.0], [30.0, 39.9]])
    found = levels_at(image, places)
    gray = GAMMA * math.log2(128 / 255)
    np.testing.assert_allclose(found, [gray, np.nan, np.nan, np.nan, np.nan, np.nan, gray], atol=1e-5)
    # x is the column
    image = np.tile(np.linspace(60, 200, 60, dtype=np.uint8)[None, :, None], (40, 1, 3))
    left, right = levels_at(image, np.array([[12.0, 30.0], [48.0, 10.0]]))
    assert right > left + 1.0


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exposures_are_found_though_a_third_of_the_points_shine_or_are_hidden(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true, albedo = rng.normal(0.0, 0.3, N_VIEWS), rng.normal(-2.0, 1.0, N_POINTS)
    seen = [rng.permutation(N_POINTS)[: rng.integers(60, 200)] for _ in range(N_VIEWS)]
    levels = []
    for i, rows in enumerate(seen):
        values = true[i] + albedo[rows] + rng.normal(0.0, 0.05, len(rows))
        wrong = rng.random(len(rows)) < 1 / 3
        values[wrong] += rng.normal(0.0, 2.0, wrong.sum())
        values[rng.random(len(rows)) < 0.1] = np.nan
        levels.append(values)
    found = exposures(levels, seen)
    np.testing.assert_allclose(found.stops, true - np.median(true), atol=0.12)
    assert found.drift == pytest.approx(true.std(), abs=0.03)
    # the errors are about as large as they are said to be
    assert 0.3 < (found.stops - (true - np.median(true))).std() / found.errors.mean() < 2.0
    # and photographs of nothing in common do not drift
    rng, seen = np.random.default_rng(seed), [np.arange(40)] * 30
    found = exposures([rng.normal(-2.0, 1.0, 40) for _ in seen], seen)
    assert np.nanstd(found.stops) > 0.15
    assert (found.drift or 0.0) < 0.1


def test_what_changes_from_place_to_place_is_no_unevenness() -> None:
    viewmats = ring(N_VIEWS)
    slow = np.sin(np.linspace(0.0, 2.0 * np.pi, N_VIEWS, endpoint=False))
    order = np.random.default_rng(0).permutation(N_VIEWS)
    for stops, low, high in ((slow, 0.0, 0.1), (slow[order], 0.6, 1.2), (np.zeros(N_VIEWS), 0.0, 0.001)):
        found = Exposures(stops, np.full(N_VIEWS, 0.01))
        assert found.drift == pytest.approx(stops.std(), abs=0.01)
        assert low <= (found.unevenness(viewmats) or 0.0) < high
    # photographs in another order are the same photographs
    exact = np.zeros(N_VIEWS)
    reordered = Exposures(slow[order], exact).unevenness(viewmats[order])
    assert reordered == pytest.approx(Exposures(slow, exact).unevenness(viewmats))
    assert Exposures(slow[:4], np.zeros(4)).unevenness(viewmats[:4]) is None


def test_a_photograph_that_shares_no_points_has_no_exposure() -> None:
    rows = [np.arange(50), np.arange(50), np.arange(100, 150), np.arange(10)]
    levels = [np.zeros(50), np.ones(50), np.ones(50), np.zeros(10)]
    found = exposures(levels, rows)
    assert np.isnan(found.stops).tolist() == [False, False, True, True]
    assert found.stops[1] - found.stops[0] == pytest.approx(1.0)
    assert found.drift == pytest.approx(0.5)
    assert exposures(levels[2:], rows[2:]).drift is None
    assert exposures([], []).drift is None


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_demo(tmp_path_factory.mktemp("drift") / "demo", views=24, width=120, height=90)


def brighter(image: np.ndarray, stops: float) -> np.ndarray:
    """Let a photograph take so many stops more light."""
    return np.clip(image * 2.0 ** (stops / GAMMA), 0.0, 255.0).round().astype(np.uint8)


@pytest.mark.slow  # it trains
@pytest.mark.parametrize(("width", "learned"), [(0.0, False), (0.4, True)])
def test_training_learns_exposures_that_differ(demo: Path, width: float, learned: bool) -> None:
    capture = load_capture(demo)
    stops = np.random.default_rng(3).permutation(np.linspace(-1.0, 1.0, len(capture.views))) * width
    changed = [replace(v, image=brighter(v.image, stop)) for v, stop in zip(capture.views, stops, strict=True)]
    config = TrainConfig.of(preset="auto", backend="fast")

    def terms(views: list[Any]) -> tuple[Exposures, Any]:
        of: Capture = replace(capture, views=tuple(views))
        return exposures_of(of), choose_terms(of, config, None)

    found, chosen = terms(changed)
    np.testing.assert_allclose(found.stops, stops - np.median(stops), atol=0.1)
    assert chosen.settings.get("exposure", False) is learned
    assert any("by their common points they differ by" in why for why in chosen.why) is learned
    found, chosen = terms([replace(view, seen=None) for view in changed])
    assert found.drift is None
    assert "exposure" not in chosen.settings


def test_data_check_says_what_training_will_do(check: Check, demo: Path, tmp_path: Path) -> None:
    assert said(check(demo), "exposure      the same points differ by 0.0")
    shutil.copytree(demo, tmp_path / "demo")
    stops = np.random.default_rng(5).permutation(np.linspace(-0.8, 0.8, 24))
    paths = sorted((tmp_path / "demo" / "images").iterdir())
    for path, stop in zip(paths, stops, strict=True):
        assert cv2.imwrite(str(path), brighter(cv2.imread(str(path)), stop))
    (line,) = [line for line in check(tmp_path / "demo") if "the same points differ" in line]
    assert line.startswith("LOOK")
    told = float(line.partition("differ by ")[2].split()[0])
    assert told == pytest.approx(stops.std(), abs=0.1)
    assert float(line.partition("a photograph differs by ")[2].split()[0]) > UNEVEN
    darkest, brightest = paths[int(stops.argmin())].name, paths[int(stops.argmax())].name
    assert re.search(rf"photograph, -0\.\d+ \({darkest}\) to \+0\.\d+ \({brightest}\); a ", line)
    assert line.endswith("; lock the exposure, or train with --exposure")


def test_a_whole_install_is_found_whole(pop: Pop) -> None:
    out = pop.done("doctor").out
    for name in ("numpy", "torch", "pycolmap", "opencv-contrib-python-headless", "backend fast", "processor", "memory"):
        assert name in out
    # what is optional is named with the words that install it
    for extra in ("viewer", "heif", "blocks"):
        assert f"pip install 'pop-splatting[{extra}]'" in out
    assert "everything that pop needs is installed" in out


@pytest.mark.parametrize(
    ("missing", "words"),
    [(None, "ok       CUDA build"), ("nvcc", "nvcc was not found; install a CUDA toolkit"), ("cmake", "[cuda-build]")],
)
def test_what_building_the_cuda_extension_lacks_is_said(pop, monkeypatch, missing, words):
    monkeypatch.setattr(build, "find_nvcc", lambda: None if missing == "nvcc" else "/opt/nvcc")
    monkeypatch.setattr(build, "_program", lambda name: None if name == missing else f"/bin/{name}")
    monkeypatch.setattr(build.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(toolkit, "nvcc_version", lambda nvcc: (13, 0))
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built")
    lines = pop.done("doctor").out.splitlines()
    assert words in next(line for line in lines if "CUDA build" in line)
    backend = next(line for line in lines if "backend cuda" in line)
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
