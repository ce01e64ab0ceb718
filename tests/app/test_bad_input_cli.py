"""Bad captures and settings on the command line: status 2, one line that names file, field and fix."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.app.conftest import TRAIN, Pop
from tests.app.damage import Damage, patch_bytes, photo, says, truncate


def corrupt_pixels(folder: Path) -> None:
    size = photo(folder).stat().st_size
    patch_bytes(photo(folder), size // 2, b"\x00\xff\x00\xff")


def corrupt_jpeg(folder: Path) -> None:
    image = cv2.imread(str(photo(folder)))
    photo(folder).unlink()
    path = photo(folder).with_suffix(".jpg")
    cv2.imwrite(str(path), image)
    truncate(path)


def other_shape(folder: Path) -> None:
    cv2.imwrite(str(photo(folder, 1)), np.zeros((40, 32, 3), np.uint8))


def camera_model(folder: Path) -> None:
    patch_bytes(folder / "sparse/0/cameras.bin", 12, struct.pack("<i", 999))


def camera_width(folder: Path) -> None:
    patch_bytes(folder / "sparse/0/cameras.bin", 16, struct.pack("<Q", 0))


def camera_focal(folder: Path) -> None:
    patch_bytes(folder / "sparse/0/cameras.bin", 32, struct.pack("<d", float("nan")))


def only_one_view(folder: Path) -> None:
    for path in sorted((folder / "images").iterdir())[1:]:
        path.unlink()


CAPTURES: list[tuple[str, Damage, tuple[str, ...]]] = [
    ("an image is listed but absent", lambda f: photo(f, 3).unlink(), ("view_003.png", "absent", "--missing skip")),
    ("a PNG is truncated", lambda f: truncate(photo(f)), ("view_000.png", "truncated", "copy it again")),
    ("a PNG is corrupt", corrupt_pixels, ("view_000.png", "corrupt", "copy it again")),
    ("a JPEG is truncated", corrupt_jpeg, ("view_000.jpg", "truncated", "copy it again")),
    ("a photograph is empty", lambda f: photo(f).write_bytes(b""), ("view_000.png", "empty", "copy it again")),
    ("a photograph is text", lambda f: photo(f).write_text("hello"), ("view_000.png", "is no image")),
    ("a photograph has another shape", other_shape, ("view_001.png", "32x40", "40x32", "use the photographs")),
    ("the cameras are truncated", lambda f: truncate(f / "sparse/0/cameras.bin"), ("cameras.bin", "truncated")),
    ("the images are truncated", lambda f: truncate(f / "sparse/0/images.bin"), ("images.bin", "truncated")),
    ("the points are truncated", lambda f: truncate(f / "sparse/0/points3D.bin"), ("points3D.bin", "truncated")),
    (
        "the points are absent",
        lambda f: (f / "sparse/0/points3D.bin").unlink(),
        ("sparse/0", "absent", "copy the model again"),
    ),
    ("the camera model is unknown", camera_model, ("cameras.bin", "unknown camera model 999")),
    ("a camera has no width", camera_width, ("cameras.bin", "camera 1", "0x32")),
    ("a focal length is NaN", camera_focal, ("cameras.bin", "camera 1", "params[0]")),
]


@pytest.mark.parametrize(("damage", "parts"), [case[1:] for case in CAPTURES], ids=[case[0] for case in CAPTURES])
def test_a_damaged_capture_is_named_before_anything_is_written(
    pop: Pop, capture: Path, tmp_path: Path, damage: Damage, parts: tuple[str, ...]
) -> None:
    damage(capture)
    says(pop("train", capture, "--out", tmp_path / "r", *TRAIN), *parts)
    assert not (tmp_path / "r").exists()


def transforms(folder: Path, **frame: object) -> Path:
    """Write a small transforms.json beside the photographs, its second frame and its fields changed as given."""
    pose = np.eye(4)
    frames = [
        {"file_path": f"images/view_{i:03d}.png", "transform_matrix": (pose + 0.1 * i * np.eye(4, k=3)).tolist()}
        for i in range(4)
    ]
    listing: dict[str, object] = {"fl_x": 30.0, "fl_y": 30.0, "cx": 20.0, "cy": 16.0, "w": 40, "h": 32}
    for key, value in frame.items():
        (frames[1] if key in ("transform_matrix", "file_path") else listing)[key] = value
    (folder / "transforms.json").write_text(json.dumps({**listing, "frames": frames}))
    return folder


STRETCHED = np.diag([2.0, 1.0, 1.0, 1.0]).tolist()
WITH_NAN = [[float("nan"), 0.0, 0.0, 0.0], *np.eye(4)[1:].tolist()]


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"transform_matrix": STRETCHED}, ("frames[1]", "transform_matrix")),
        ({"transform_matrix": WITH_NAN}, ("frames[1]", "transform_matrix")),
        ({"transform_matrix": [[1.0]]}, ("frames[1]", "transform_matrix")),
        ({"file_path": "images/gone.png"}, ("gone.png", "absent", "--missing skip")),
        ({"fl_x": 0.0}, ("focal length", "> 0")),
        ({"w": 0}, ("w",)),
        ({"camera_model": "SPHERE"}, ("camera_model", "SPHERE")),
    ],
    ids=["non-rigid", "NaN", "wrong shape", "absent image", "singular K", "no width", "unknown camera model"],
)
def test_a_bad_transforms_json_is_named_with_its_frame_and_field(
    pop: Pop, capture: Path, tmp_path: Path, change: dict[str, object], parts: tuple[str, ...]
) -> None:
    folder = transforms(capture, **change)
    outcome = pop("train", folder, "--source", "transforms", "--out", tmp_path / "r", *TRAIN)
    says(outcome, "transforms.json", *parts)
    assert not (tmp_path / "r").exists()


def test_broken_json_is_named_with_its_place(pop: Pop, capture: Path, tmp_path: Path) -> None:
    (capture / "transforms.json").write_text('{"frames": [')
    outcome = pop("train", capture, "--source", "transforms", "--out", tmp_path / "r")
    says(outcome, "transforms.json", "not valid JSON", "line 1")


def test_a_folder_that_is_not_there_is_named(pop: Pop, tmp_path: Path) -> None:
    says(pop("train", tmp_path / "gone", "--out", tmp_path / "r"), "gone", "no such folder", "give the folder")
    assert not (tmp_path / "r").exists()


def test_a_folder_without_photographs_is_named(pop: Pop, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    says(pop("train", tmp_path / "empty", "--out", tmp_path / "r"), "empty", "no photographs", "give the folder")


def test_absent_images_can_be_skipped_but_one_view_is_too_few(pop: Pop, capture: Path, tmp_path: Path) -> None:
    only_one_view(capture)
    outcome = pop("train", capture, "--out", tmp_path / "r", "--missing", "skip", *TRAIN)
    says(outcome, "a scene")
    assert not (tmp_path / "r").exists()


def test_one_photograph_is_too_few_for_sfm(pop: Pop, capture: Path, tmp_path: Path) -> None:
    only_one_view(capture)
    says(pop("sfm", capture / "images", "--out", tmp_path / "r"), "1 photograph", "two or more")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["--factor", "0"], ("factor is 0", "at least 1")),
        (["--sh-degree", "4"], ("sh_degree is 4",)),
        (["--steps-scaler", "-1"], ("steps_scaler is -1.0", "> 0")),
        (["--background", "2", "0", "0"], ("background", "[0, 1]")),
        (["--init-opacity", "1"], ("init_opacity is 1.0",)),
        (["--factor", "99"], ("factor 99", "lower it")),
        (["--test-every", "1"], ("no view to train on", "test_every")),
        (["--lpips-vgg", "gone.pth"], ("gone.pth", "LPIPS")),
        (["--resume", "--overwrite"], ("--resume and --overwrite",)),
        (["--images", "gone"], ("gone",)),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_setting_out_of_range_is_named(
    pop: Pop, shared_capture: Path, tmp_path: Path, words: list[str], parts: tuple[str, ...]
) -> None:
    says(pop("train", shared_capture, "--out", tmp_path / "r", "--quiet", *words), *parts)
    assert not (tmp_path / "r").exists()
