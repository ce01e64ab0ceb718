"""Plain points from PLY: colours as any program stores them, headers in any language."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pop_fast.io.ply_rows import read_points
from tests.app.captures import assert_one_line


def write(path: Path, kind: str, colors: np.ndarray | list[float], text: bool = False) -> Path:
    """Write points at the origin with the same number for red, green and blue."""
    rows = np.zeros(len(colors), [*((n, "f4") for n in "xyz"), *((n, kind) for n in ("red", "green", "blue"))])
    for name in ("red", "green", "blue"):
        rows[name] = colors
    PlyData([PlyElement.describe(rows, "vertex")], text=text).write(str(path))
    return path


@pytest.mark.parametrize(
    ("kind", "stored", "read"),
    [
        ("u1", [0, 1, 128, 255], [0, 1, 128, 255]),
        ("u2", [0, 257, 40_000, 65_535], [0, 1, 156, 255]),
        ("u2", [0, 1, 128, 255], [0, 1, 128, 255]),
        ("i4", [0, 1, 128, 255], [0, 1, 128, 255]),
        ("f4", [0.0, 0.5, 1.0, 0.2], [0, 128, 255, 51]),
        ("f8", [0.0, 0.5, 1.001, 0.2], [0, 128, 255, 51]),
        ("f4", [0.0, 1.0, 200.4, 255.0], [0, 1, 200, 255]),
    ],
)
@pytest.mark.parametrize("text", [True, False])
def test_colours_of_any_kind_are_read(
    tmp_path: Path, kind: str, stored: list[float], read: list[int], text: bool
) -> None:
    _, rgb = read_points(write(tmp_path / "p.ply", kind, stored, text))
    assert rgb.dtype == np.uint8
    assert rgb.tolist() == [[value] * 3 for value in read]


@pytest.mark.parametrize(("kind", "stored"), [("f4", np.nan), ("f4", np.inf), ("f4", -0.5), ("i4", -1), ("i4", 70_000)])
def test_a_colour_that_is_none_is_named_without_a_warning(tmp_path: Path, kind: str, stored: float) -> None:
    path = write(tmp_path / "p.ply", kind, [0, stored])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_one_line(lambda: read_points(path), "p.ply", f"vertex[1].red is {stored:g}", "65535")


def test_an_absurd_coordinate_is_named(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\n"
    (tmp_path / "p.ply").write_text(header + "end_header\n0 1e200 0\n")
    assert_one_line(lambda: read_points(tmp_path / "p.ply"), "p.ply", "vertex[0].y is 1e+200", "within 1e+15")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_comments_in_any_language_do_no_harm(tmp_path: Path, text: bool, encoding: str) -> None:
    path = write(tmp_path / "p.ply", "u1", [10, 13, 200, 255], text)
    head, first, rest = path.read_bytes().partition(b"element")
    path.write_bytes(head + "comment end_header für Küche\n".encode(encoding) + first + rest)
    xyz, rgb = read_points(path)
    assert xyz.shape == (4, 3)
    assert rgb[:, 0].tolist() == [10, 13, 200, 255]
