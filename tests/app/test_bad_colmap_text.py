"""COLMAP models in text, which people write by hand: what is wrong is named by file, line and field."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pop_fast.data import load_capture
from tests.app.captures import assert_one_line, colmap_capture, ring


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
    ],
)
def test_a_wrong_field_is_named(tmp_path: Path, file: str, old: str, new: str, words: tuple[str, ...]) -> None:
    root = colmap_capture(tmp_path, binary=False)
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
