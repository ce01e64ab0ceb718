"""Whatever is wrong with a capture is said in one line that names the file, the field and the fix."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pop_fast.data import CaptureError, load_capture
from pop_fast.errors import PopError
from tests.app.captures import (
    assert_one_line,
    camera,
    colmap_capture,
    edit_transforms,
    photograph,
    ring,
    transforms_capture,
    write_model,
    write_photograph,
)


def test_every_message_is_one_line_whatever_it_was_made_from() -> None:
    assert str(PopError("a\n  b\tc")) == "a b c"
    assert issubclass(CaptureError, PopError)
    assert issubclass(PopError, ValueError)


# folders


def test_a_missing_folder_a_file_and_an_empty_folder_are_told_apart(tmp_path: Path) -> None:
    assert_one_line(lambda: load_capture(tmp_path / "absent"), "absent", "no such folder")
    (tmp_path / "file").write_text("")
    assert_one_line(lambda: load_capture(tmp_path / "file"), "file", "not a folder")
    (tmp_path / "empty").mkdir()
    assert_one_line(lambda: load_capture(tmp_path / "empty"), "empty", "no photographs", "no COLMAP model")


def test_a_source_that_is_not_there_is_named(tmp_path: Path) -> None:
    write_photograph(tmp_path / "a.png", photograph(0))
    assert_one_line(lambda: load_capture(tmp_path, source="colmap"), "no COLMAP model", "pop sfm")
    assert_one_line(lambda: load_capture(tmp_path, source="transforms"), "no transforms.json")
    assert_one_line(lambda: load_capture(tmp_path), "1 photographs", "pop sfm")


def test_a_model_without_photographs_is_named(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path)
    (root / "images").rename(root / "pictures")
    assert_one_line(lambda: load_capture(root), str(root / "images"), "--images")
    assert_one_line(lambda: load_capture(root, images="photos"), str(root / "photos"), "--images")
    assert len(load_capture(root, images="pictures").views) == 4


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("binary", [True, False])
def test_an_absent_file_of_a_model_is_named(tmp_path: Path, file: str, binary: bool) -> None:
    root = colmap_capture(tmp_path, binary=binary)
    suffix = ".bin" if binary else ".txt"
    (root / "sparse" / "0" / f"{file}{suffix}").unlink()
    words = (file, "absent")
    assert_one_line(lambda: load_capture(root, source="colmap"), *words)


def test_fewer_than_two_views_are_refused(tmp_path: Path) -> None:
    assert_one_line(lambda: load_capture(colmap_capture(tmp_path / "a", count=1)), "sparse", "1 view(s)", "two or more")
    assert_one_line(lambda: load_capture(transforms_capture(tmp_path / "b", count=1)), "transforms.json", "1 view(s)")
    root = colmap_capture(tmp_path / "c", count=2)
    (root / "images" / "00.png").unlink()
    assert_one_line(lambda: load_capture(root, missing="skip", normalize=False), "1 view(s)", "two or more")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"factor": 0}, ("factor is 0", "at least 1")),
        ({"factor": 1.5}, ("factor is 1.5", "whole number")),
        ({"factor": 1000}, ("40x30", "factor 1000")),
        ({"missing": "ignore"}, ("missing is 'ignore'", "'skip'")),
        ({"background": (0.0, 0.0, 255.0)}, ("background", "[0, 1]")),
        ({"background": (0.0,)}, ("background", "three numbers")),
    ],
)
def test_impossible_options_are_named(tmp_path: Path, options: dict[str, Any], words: tuple[str, ...]) -> None:
    root = colmap_capture(tmp_path)
    assert_one_line(lambda: load_capture(root, **options), *words)


def test_cameras_that_did_not_move_are_refused(tmp_path: Path) -> None:
    write_model(tmp_path / "sparse" / "0", ["a.png", "b.png"], ring(1)[[0, 0]])
    for i, name in enumerate("ab"):
        write_photograph(tmp_path / "images" / f"{name}.png", photograph(i))
    assert_one_line(lambda: load_capture(tmp_path), "sparse", "one place")


# binary models


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return colmap_capture(tmp_path_factory.mktemp("model"))


def with_damage(root: Path, file: str, damage: Callable[[bytes], bytes]) -> str:
    """Damage a file of a model, try to load it, repair it, and return the one line."""
    path = root / "sparse" / "0" / file
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    try:
        return assert_one_line(lambda: load_capture(root))
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
@given(cut=st.floats(0.0, 1.0, exclude_max=True))
def test_a_model_file_cut_anywhere_is_named(file: str, cut: float, model: Path) -> None:
    message = with_damage(model, file, lambda data: data[: int(cut * len(data))])
    assert file in message
    assert "truncated" in message


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_a_model_file_with_more_than_it_says_is_named(file: str, model: Path) -> None:
    message = with_damage(model, file, lambda data: data + b"more")
    assert file in message
    assert "4 bytes too many" in message


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_an_absurd_count_asks_for_no_memory(file: str, model: Path) -> None:
    assert file in with_damage(model, file, lambda data: struct.pack("<Q", 2**60) + data[8:])


def patched(offset: int, value: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data[:offset] + value + data[offset + len(value) :]


@pytest.mark.parametrize(
    ("file", "offset", "value", "words"),
    [
        ("cameras.bin", 12, struct.pack("<i", 77), ("camera 1", "unknown camera model 77")),
        ("cameras.bin", 12, struct.pack("<i", -2), ("unknown camera model -2",)),
        ("cameras.bin", 16, struct.pack("<Q", 0), ("camera 1 (PINHOLE)", "0x30 px")),
        ("cameras.bin", 32, struct.pack("<d", np.nan), ("params[0] is nan",)),
        ("cameras.bin", 48, struct.pack("<d", np.inf), ("params[2] is inf",)),
        ("cameras.bin", 48, struct.pack("<d", 1e200), ("params[2] is 1e+200", "within")),
        ("cameras.bin", 32, struct.pack("<d", 0.0), ("focal length 0.0", "> 0")),
        ("cameras.bin", 40, struct.pack("<d", -5.0), ("focal length -5.0",)),
        ("points3D.bin", 16, struct.pack("<d", np.nan), ("point 1", "X is nan")),
        ("points3D.bin", 16, struct.pack("<d", 1e200), ("point 1", "X is 1e+200", "within")),
        ("points3D.bin", 51, struct.pack("<Q", 2**63), ("truncated",)),
        ("images.bin", 12, struct.pack("<d", np.nan), ("image 1 (00.png)", "quaternion", "nan")),
        ("images.bin", 12, bytes(32), ("image 1 (00.png)", "quaternion QW QX QY QZ", "not zero")),
        ("images.bin", 44, struct.pack("<d", -1e200), ("image 1 (00.png)", "translation", "-1e+200")),
        ("images.bin", 68, struct.pack("<I", 9), ("image 1 (00.png)", "CAMERA_ID 9", "cameras.bin")),
        ("images.bin", 72, b"\xfc", ("image 1", "\\xfc", "not UTF-8")),
    ],
)
def test_a_wrong_field_of_a_model_is_named(
    model: Path, file: str, offset: int, value: bytes, words: tuple[str, ...]
) -> None:
    message = with_damage(model, file, patched(offset, value))
    assert file in message
    for word in words:
        assert word in message


# transforms.json


def frame(**fields: Any) -> Callable[[dict[str, Any]], object]:
    return lambda listing: listing["frames"][1].update(fields)


def matrix(change: Callable[[np.ndarray], Any]) -> Callable[[dict[str, Any]], object]:
    def edit(listing: dict[str, Any]) -> None:
        m = change(np.array(listing["frames"][1]["transform_matrix"]))
        listing["frames"][1]["transform_matrix"] = m.tolist() if isinstance(m, np.ndarray) else m

    return edit


def entry(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(m: np.ndarray) -> np.ndarray:
        m[row, column] = value
        return m

    return change


BAD_FIELDS: dict[str, tuple[Callable[[dict[str, Any]], object], tuple[str, ...]]] = {
    "no frames": (lambda listing: listing.pop("frames"), ("'frames'",)),
    "frames is a number": (lambda listing: listing.update(frames=3), ("'frames'",)),
    "a frame is a number": (lambda listing: listing["frames"].append(3), ("frames[4]", "file_path")),
    "no file_path": (lambda listing: listing["frames"][1].pop("file_path"), ("frames[1]", "file_path")),
    "no matrix": (
        lambda listing: listing["frames"][1].pop("transform_matrix"),
        ("frames[1]", "transform_matrix", "4x4"),
    ),
    "3x3 matrix": (matrix(lambda m: m[:3, :3]), ("frames[1]", "[3, 3]", "4x4")),
    "ragged matrix": (matrix(lambda m: [[1.0], [1.0, 2.0]]), ("frames[1]", "4x4")),
    "words for a matrix": (matrix(lambda m: [["a"] * 4] * 4), ("frames[1]", "4x4")),
    "NaN": (matrix(entry(1, 3, np.nan)), ("frames[1]", "transform_matrix", "[1][3] is nan", "finite")),
    "Inf": (matrix(entry(0, 0, np.inf)), ("frames[1]", "[0][0] is inf")),
    "scaled": (matrix(lambda m: m * [[2.0], [2.0], [2.0], [1.0]]), ("frames[1]", "not rigid", "scales by 2")),
    "sheared": (matrix(lambda m: m @ (np.eye(4) + 0.1 * np.eye(4, k=1))), ("frames[1]",)),
    "mirrored": (matrix(lambda m: m @ np.diag([-1.0, 1.0, 1.0, 1.0])), ("frames[1]", "mirrors")),
    "transposed": (matrix(lambda m: m.T), ("frames[1]", "last row")),
    "zero": (matrix(lambda m: m * 0.0), ("frames[1]",)),
    "no focal length": (lambda listing: listing.pop("fl_x"), ("frames[0]", "fl_x", "camera_angle_x")),
    "focal length 0": (frame(fl_x=0.0), ("frames[1]", "focal length")),
    "focal length -1": (frame(fl_y=-1), ("frames[1]", "focal length")),
    "focal length NaN": (frame(fl_x=float("nan")), ("frames[1]", "fl_x is nan", "finite")),
    "focal length a word": (frame(fl_x="long"), ("frames[1]", "fl_x is 'long'")),
    "focal length true": (frame(fl_x=True), ("frames[1]", "fl_x is True")),
    "principal point a list": (frame(cx=[1]), ("frames[1]", "cx is [1]")),
    "width 0": (frame(w=0), ("frames[1]", "0 x 30")),
    "no size": (lambda listing: (listing.pop("w"), listing.pop("h")), ("frames[0]", "w and h are absent")),
    "no height": (lambda listing: listing.pop("h"), ("frames[0]", "h is None")),
    "unknown lens": (frame(camera_model="PANINI"), ("frames[1]", "camera_model is 'PANINI'", "OPENCV")),
    "fourth radial term": (frame(k4=0.1), ("frames[1]", "k4 is 0.1")),
    "focal length of 400 digits": (frame(fl_x=10**400), ("frames[1]", "fl_x is 1000", "finite")),
    "matrix of 400 digits": (matrix(lambda m: [[10**400] * 4] * 4), ("frames[1]", "4x4")),
    "camera beyond the stars": (matrix(entry(0, 3, 1e200)), ("frames[1]", "[0][3] is 1e+200", "within")),
    "width 1e300": (frame(w=1e300), ("frames[1]", "w x h", "at most")),
    "split a number": (lambda listing: listing.update(val_filenames=5), ("val_filenames is 5", "list")),
    "points a list": (lambda listing: listing.update(ply_file_path=[]), ("ply_file_path is []", "PLY")),
    "listed twice": (lambda listing: listing["frames"].append(listing["frames"][0]), ("images/00.png twice",)),
    "split of unknown": (lambda listing: listing.update(test_filenames=["no.png"]), ("test_filenames", "no.png")),
}


@pytest.mark.parametrize("what", BAD_FIELDS)
def test_a_wrong_field_of_transforms_json_is_named(tmp_path: Path, what: str) -> None:
    root = transforms_capture(tmp_path)
    edit, words = BAD_FIELDS[what]
    edit_transforms(root, edit)
    assert_one_line(lambda: load_capture(root), str(root / "transforms.json"), *words)


@pytest.mark.parametrize("angle", [0.0, -1.0, 4.0])
def test_an_impossible_field_of_view_is_named(tmp_path: Path, angle: float) -> None:
    none = dict.fromkeys(("w", "h", "fl_x", "fl_y", "cx", "cy"))
    root = transforms_capture(tmp_path, camera_angle_x=angle, **none)
    assert_one_line(lambda: load_capture(root), "frames[0]", "camera_angle_x", "radians")


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff\xfe\x00", b'{"frames": [}', b"[" * 99_999, b'{"w":' + b"1" * 9999]
)
def test_a_file_that_is_no_json_object_is_named(tmp_path: Path, content: bytes) -> None:
    root = transforms_capture(tmp_path)
    (root / "transforms.json").write_bytes(content)
    assert_one_line(lambda: load_capture(root), str(root / "transforms.json"))


def test_a_lens_that_folds_the_image_is_named_with_its_photograph(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, cameras=[camera("SIMPLE_RADIAL", (2.0, 20.0, 15.0, -0.9))])
    assert_one_line(lambda: load_capture(root), ".png", "SIMPLE_RADIAL", "folds", "undistort")


@pytest.mark.parametrize(
    "content", [b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n", b"", b"ply"]
)
def test_damaged_points_beside_transforms_json_are_named(tmp_path: Path, content: bytes) -> None:
    root = transforms_capture(tmp_path)
    (root / "sparse_pc.ply").write_bytes(content)
    assert_one_line(lambda: load_capture(root), "sparse_pc.ply", "truncated or corrupt")


# COLMAP models in text, which people write by hand: what is wrong is named by file, line and field.


def edit(root: Path, file: str, old: str, new: str) -> None:
    """Change the first record of a text file."""
    path = root / "sparse" / "0" / file
    lines = path.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    assert old in lines[first]
    lines[first] = lines[first].replace(old, new, 1)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("cameras.txt", "PINHOLE", "PINHOLES", ("line 4", "MODEL is 'PINHOLES'", "SIMPLE_RADIAL")),
        ("cameras.txt", "36", "abc", ("line 4", "PARAMS[0] is 'abc'", "a number")),
        ("cameras.txt", "36", "NaN", ("camera 1 (PINHOLE)", "params[0] is nan")),
        ("cameras.txt", " 14.25", "", ("line 4", "PARAMS[] has 3 numbers", "PINHOLE has 4")),
        ("cameras.txt", " 40 30 ", " 0 30 ", ("0x30",)),
        ("cameras.txt", " 40 30 ", " 40.5 30 ", ("WIDTH is '40.5'", "whole number")),
        ("cameras.txt", " 30 36 35 20.5 14.25", "", ("line 4", "HEIGHT is absent", "CAMERA_ID, MODEL, WIDTH")),
        ("images.txt", " 1 00.png", " 9 00.png", ("image 1 (00.png)", "CAMERA_ID 9", "cameras.txt")),
        ("images.txt", " 1 00.png", " 1 01.png", ("01.png", "listed twice")),
        ("images.txt", " 1 00.png", " 00.png", ("line 5", "NAME is absent")),
        ("points3D.txt", "1 ", "one ", ("line 4", "POINT3D_ID is 'one'", "whole number")),
        ("points3D.txt", None, " 1", ("line 4", "TRACK[] has 1 numbers", "IMAGE_ID, POINT2D_IDX")),
        ("points3D.txt", None, " x 0", ("line 4", "TRACK[] IMAGE_ID is 'x'", "whole number")),
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, file: str, old: str | None, new: str, words: tuple[str, ...]) -> None:
    root = colmap_capture(tmp_path, binary=False)
    if old is None:
        # at the end of the first record
        old = (root / "sparse" / "0" / file).read_text().splitlines()[3].rstrip()
        new = old + new
    edit(root, file, old, new)
    assert_one_line(lambda: load_capture(root), file, *words)


def test_a_file_without_records_and_one_in_another_encoding_are_named(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, binary=False)
    cameras = root / "sparse" / "0" / "cameras.txt"
    whole = cameras.read_text()
    cameras.write_text("")
    assert_one_line(lambda: load_capture(root), "images.txt", "image 1 (00.png)", "CAMERA_ID 1", "cameras.txt")
    cameras.write_bytes(b"# K\xfcche\n" + whole.encode())
    assert_one_line(lambda: load_capture(root), "cameras.txt", "not UTF-8")


def test_images_without_the_empty_line_for_observations_are_refused_and_not_halved(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, names=["0.png", "1 b.png", "2 b c.png", "3.png"], binary=False)
    path = root / "sparse" / "0" / "images.txt"
    lines = [line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    for last in range(2, 5):
        path.write_text("\n".join([lines[0], *lines[last - 1 : last]]) + "\n")
        assert_one_line(lambda: load_capture(root), "images.txt", "line 2", "POINTS2D", "0.png", "empty line")


def test_names_with_spaces_comments_and_other_line_ends_are_read(tmp_path: Path) -> None:
    names = ["a b.png", "left/c  d.png", "Küche.png"]
    root = colmap_capture(tmp_path, names=names, binary=False)
    for file in (root / "sparse" / "0").iterdir():
        text = "\ufeff  # by hand\n\n" + file.read_text(encoding="utf-8")
        file.write_bytes(text.replace("\n", "\r\n").encode())
    assert {view.name for view in load_capture(root).views} == set(names)


@pytest.mark.parametrize("scale", [2.0, 0.001, 1e200])
def test_quaternions_of_any_norm_are_the_rotation_that_they_mean(tmp_path: Path, scale: float) -> None:
    root = colmap_capture(tmp_path, binary=False)
    rescale(root, lambda quat: [f"{scale * float(q)}" for q in quat])
    for view, viewmat in zip(load_capture(root, normalize=False).views, ring(4), strict=True):
        assert np.allclose(view.viewmat, viewmat, atol=1e-12)


def test_quaternions_rounded_by_hand_are_made_rotations_again(tmp_path: Path) -> None:
    root = colmap_capture(tmp_path, binary=False)
    rescale(root, lambda quat: [f"{float(q):.3f}" for q in quat])
    for view, viewmat in zip(load_capture(root, normalize=False).views, ring(4), strict=True):
        R = view.viewmat[:3, :3]
        assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
        assert np.abs(R - viewmat[:3, :3]).max() < 3e-3


@pytest.mark.parametrize("quat", ["0", "1e-200", "nan"])
def test_a_quaternion_that_is_no_rotation_is_named(tmp_path: Path, quat: str) -> None:
    root = colmap_capture(tmp_path, binary=False)
    rescale(root, lambda _: [quat] * 4)
    assert_one_line(lambda: load_capture(root), "images.txt", "image 1 (00.png)", "quaternion QW QX QY QZ", "not zero")


def rescale(root: Path, change) -> None:
    """Rewrite the quaternions of images.txt."""
    path = root / "sparse" / "0" / "images.txt"
    lines = path.read_text().split("\n")
    for i, line in enumerate(lines):
        words = line.split()
        if len(words) == 10 and words[-1].endswith(".png"):
            lines[i] = " ".join([words[0], *change(words[1:5]), *words[5:]])
    path.write_text("\n".join(lines))
