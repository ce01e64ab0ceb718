"""PLY headers that promise what the file does not hold: refused in one line before a row is read.

A file of twelve lines used to end the interpreter: an element of -1 rows without properties made numpy divide by zero
where it maps a file.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from pop_fast.errors import PopError
from pop_fast.io.ply import is_antialiased, load_ply, save_ply
from pop_fast.io.ply_rows import read_points
from tests.app.captures import assert_one_line
from tests.app.children import pop_in_a_child
from tests.app.damage import says
from tests.app.test_ply import assert_same_bits, some_params

XYZ = "property float x\nproperty float y\nproperty float z\n"
KILLER = f"ply\nformat binary_little_endian 1.0\nelement foo -1\nelement vertex 1\n{XYZ}end_header\n"


def binary(path: Path, elements: str, rows: bytes = b"", order: str = "little") -> Path:
    header = f"ply\nformat binary_{order}_endian 1.0\n{elements}end_header\n"
    path.write_bytes(header.encode() + rows)
    return path


def test_a_header_that_ended_the_interpreter_is_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    path.write_bytes(KILLER.encode() + bytes(12))
    says(pop_in_a_child("export", path, "--out", tmp_path / "o.splat"), "x.ply", "'element foo -1'", "write it again")
    assert not (tmp_path / "o.splat").exists()


def test_so_are_the_points_of_a_capture(capture: Path) -> None:
    frames = [
        {"file_path": f"images/{path.name}", "transform_matrix": np.eye(4).tolist()}
        for path in sorted((capture / "images").iterdir())
    ]
    model = {"fl_x": 30.0, "fl_y": 30.0, "cx": 20.0, "cy": 16.0, "w": 40, "h": 32, "frames": frames}
    (capture / "transforms.json").write_text(json.dumps({**model, "ply_file_path": "points.ply"}))
    (capture / "points.ply").write_bytes(KILLER.encode() + bytes(12))
    outcome = pop_in_a_child("train", capture, "--out", capture.parent / "o", "--source", "transforms", "--quiet")
    says(outcome, "points.ply", "'element foo -1'")


@pytest.mark.parametrize(
    ("elements", "rows", "words"),
    [
        (f"element vertex -1\n{XYZ}", 12, ("line 3", "'element vertex -1'")),
        (f"element vertex 1_0\n{XYZ}", 120, ("'element vertex 1_0'",)),
        (f"element vertex {10**30}\n{XYZ}", 12, ("'element vertex 1",)),
        ("element vertex 0\n", 0, ("element 'vertex' has no properties",)),
        (f"element vertex 1\n{XYZ}element foo 7\n", 12, ("element 'foo' has no properties",)),
        (f"element vertex 2\n{XYZ}", 23, ("23 bytes after the header cannot be its rows (2 of vertex)",)),
        (f"element vertex {10**17}\n{XYZ}", 12, ("cannot be its rows",)),
        (f"element foo {10**17}\nproperty list uchar int a\nelement vertex 1\n{XYZ}", 12, ("cannot be its rows",)),
        (f"element vertex 1\n{XYZ}property float x\n", 16, ("two properties of a name",)),
        (f"element vertex 1\n{XYZ}property float128 w\n", 28, ("'property float128 w'",)),
        (f"{XYZ}element vertex 1\n", 12, ("line 3", "'property float x'")),
        ("format ascii 1.0\n", 0, ("line 3", "'format ascii 1.0'")),
        (f"element vertex 1\n{XYZ}shape round\n", 12, ("'shape round'",)),
        ("comment " + "x" * 2**20 + "\n", 0, ("its header has no end",)),
    ],
)
def test_a_promise_that_is_not_kept_is_named(elements: str, rows: int, words: tuple[str, ...], tmp_path: Path) -> None:
    path = binary(tmp_path / "x.ply", elements, bytes(rows))
    assert_one_line(lambda: read_points(path), "x.ply", "truncated or corrupt", *words)
    assert_one_line(lambda: load_ply(path), "x.ply", *words)


def test_rows_of_text_that_are_promised_need_room_too(tmp_path: Path) -> None:
    (tmp_path / "x.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 100000000\n{XYZ}end_header\n0 0 0\n")
    assert_one_line(lambda: read_points(tmp_path / "x.ply"), "cannot be its rows (100000000 of vertex)")
    (tmp_path / "x.ply").write_text(f"ply\nformat ascii 1.0\nelement vertex 1\n{XYZ}end_header\n0 0 0")
    assert read_points(tmp_path / "x.ply")[0].tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize("name", ["x", "rot_2", "f_rest_7", "red"])
def test_a_list_under_the_name_of_a_number_is_named(name: str, tmp_path: Path) -> None:
    columns = [*"xyz", "red", "green", "blue", "opacity", *(f"f_dc_{i}" for i in range(3))]
    columns += [*(f"f_rest_{i}" for i in range(9)), *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    lines = "".join(f"property {'list uchar ' if c == name else ''}float {c}\n" for c in columns)
    row = b"".join((b"\1" if c == name else b"") + struct.pack("<f", 0.5) for c in columns)
    path = binary(tmp_path / "x.ply", f"element vertex 1\n{lines}", row)
    reader = read_points if name == "red" else load_ply
    assert_one_line(lambda: reader(path), f"x.ply: vertex.{name} is a list; it must be one number a vertex")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_lines_may_end_in_any_way(end: str, order: str, tmp_path: Path) -> None:
    header = (
        f"ply\nformat binary_{order}_endian 1.0\ncomment SplatRenderMode: mip\n\nelement vertex 1\n{XYZ}end_header\n"
    )
    rows = struct.pack("<3f" if order == "little" else ">3f", 1.0, 2.0, 13.0)
    (tmp_path / "x.ply").write_bytes(header.replace("\n", end).encode() + rows)
    assert read_points(tmp_path / "x.ply")[0].tolist() == [[1.0, 2.0, 13.0]]
    assert is_antialiased(tmp_path / "x.ply")


def test_faces_before_and_behind_the_vertices_do_no_harm(tmp_path: Path) -> None:
    points = np.array([(1.0, 2.0, 3.0)], [(n, "f4") for n in "xyz"])
    faces = np.empty(2, [("vertex_indices", object)])
    faces["vertex_indices"] = [np.array([0, 0, 0], "i4"), np.array([0, 0, 0, 0], "i4")]
    vertex, face = PlyElement.describe(points, "vertex"), PlyElement.describe(faces, "face")
    for place, elements in enumerate(([vertex, face], [face, vertex])):
        PlyData(elements).write(str(tmp_path / f"{place}.ply"))
        assert read_points(tmp_path / f"{place}.ply")[0].tolist() == [[1.0, 2.0, 3.0]]


def test_what_stands_behind_the_rows_is_not_read(tmp_path: Path) -> None:
    save_ply(tmp_path / "x.ply", some_params())
    with open(tmp_path / "x.ply", "ab") as file:
        file.write(b"more")
    assert_same_bits(load_ply(tmp_path / "x.ply"), some_params())


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    with pytest.raises(PopError, match="could not be read: Is a directory"):
        read_points(tmp_path)
