"""Splats survive PLY bit for bit, in the layout that other programs read."""

from __future__ import annotations

import json
import math
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from plyfile import PlyData, PlyElement

from pop_fast.errors import PopError
from pop_fast.io.formats import save_as
from pop_fast.io.ply import is_antialiased, load_ply, read_points, save_ply
from tests.app.captures import assert_one_line
from tests.app.conftest import pop_in_a_child
from tests.app.damage import says

ANY = {"allow_nan": False, "allow_infinity": False, "width": 32}


def some_params(n: int = 5, bands: int = 15, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shapes = {
        "means": (n, 3),
        "scales": (n, 3),
        "quats": (n, 4),
        "opacities": (n,),
        "sh0": (n, 1, 3),
        "shN": (n, bands, 3),
    }
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def assert_same_bits(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype == torch.float32
        assert a[name].shape == b[name].shape
        assert torch.equal(a[name].view(torch.int32), b[name].view(torch.int32)), name


@given(
    table=st.integers(0, 4).flatmap(lambda n: hnp.arrays(np.float32, (n, 59), elements=st.floats(**ANY))),
)
def test_a_round_trip_keeps_every_bit(table: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> None:
    table = table.copy()
    table[:, 3] = np.where(table[:, 3:7].any(axis=1), table[:, 3], 1.0)
    n = len(table)
    params = {
        "means": torch.from_numpy(table[:, :3].copy()),
        "quats": torch.from_numpy(table[:, 3:7].copy()),
        "scales": torch.from_numpy(table[:, 7:10].copy()),
        "opacities": torch.from_numpy(table[:, 10].copy()),
        "sh0": torch.from_numpy(table[:, 11:14].copy()).reshape(n, 1, 3),
        "shN": torch.from_numpy(table[:, 14:].copy()).reshape(n, 15, 3),
    }
    path = tmp_path_factory.mktemp("ply") / "x.ply"
    assert save_ply(path, params) == (n, n)
    assert_same_bits(load_ply(path), params)


def test_the_file_is_laid_out_as_the_reference_code_lays_it_out(tmp_path: Path) -> None:
    params = some_params(2)
    save_ply(tmp_path / "x.ply", params)
    header, body = (tmp_path / "x.ply").read_bytes().split(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:4] == [
        "ply",
        "format binary_little_endian 1.0",
        "comment SplatRenderMode: default",
        "element vertex 2",
    ]
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert lines[4:] == [f"property float {name}" for name in names]
    assert len(body) == 2 * 248
    rows = np.frombuffer(body, "<f4").reshape(2, 62)
    assert np.array_equal(rows[:, 3:6], np.zeros((2, 3)))
    # channel-major: the fifteen red coefficients first
    assert np.array_equal(rows[:, 9:24], params["shN"][:, :, 0].numpy())
    assert np.array_equal(rows[:, 24:39], params["shN"][:, :, 1].numpy())
    assert np.array_equal(rows[:, 54], params["opacities"].numpy())


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_columns_are_found_by_name_in_any_order_among_others(tmp_path: Path, text: bool, byte_order: str) -> None:
    params = some_params(3)
    save_ply(tmp_path / "a.ply", params)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    order = [name for name in reversed(rows.dtype.names) if name not in ("nx", "ny", "nz")]
    mixed = np.zeros(3, [("confidence", "f8"), *((name, "f4") for name in order), ("id", "i4")])
    for name in order:
        mixed[name] = rows[name]
    faces = PlyElement.describe(np.zeros(1, [("quality", "f4")]), "face")
    ply = PlyData([faces, PlyElement.describe(mixed, "vertex")], text=text, byte_order=byte_order)
    ply.write(str(tmp_path / "b.ply"))
    loaded = load_ply(tmp_path / "b.ply")
    if text:
        assert all(torch.allclose(loaded[name], params[name], rtol=1e-6) for name in params)
    else:
        assert_same_bits(loaded, params)


@pytest.mark.parametrize("bands", [0, 3, 8])
def test_lower_degrees_are_padded_with_zeros_on_writing_and_on_reading(tmp_path: Path, bands: int) -> None:
    params = some_params(3, bands)
    padded = params | {"shN": torch.cat([params["shN"], torch.zeros(3, 15 - bands, 3)], dim=1)}
    save_ply(tmp_path / "a.ply", params)
    assert_same_bits(load_ply(tmp_path / "a.ply"), padded)
    rows = PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    kept = [name for name in rows.dtype.names if not name.startswith("f_rest")]
    few = np.zeros(3, [(name, "f4") for name in [*kept, *(f"f_rest_{i}" for i in range(3 * bands))]])
    for name in kept:
        few[name] = rows[name]
    for i, column in enumerate(params["shN"].permute(0, 2, 1).reshape(3, -1).T.numpy()):
        few[f"f_rest_{i}"] = column
    PlyData([PlyElement.describe(few, "vertex")]).write(str(tmp_path / "b.ply"))
    assert_same_bits(load_ply(tmp_path / "b.ply"), padded)


def test_transparent_gaussians_are_left_out_on_request_and_counted(tmp_path: Path) -> None:
    params = some_params(4)
    params["opacities"] = torch.tensor([math.log(1.01 / 253.99), math.log(0.99 / 254.01), -20.0, 3.0])
    assert save_ply(tmp_path / "all.ply", params) == (4, 4)
    assert save_ply(tmp_path / "few.ply", params, drop_transparent=True) == (4, 2)
    kept = load_ply(tmp_path / "few.ply")
    assert_same_bits(kept, {name: value[[0, 3]] for name, value in params.items()})


def test_antialiased_splats_say_so_in_the_header(tmp_path: Path) -> None:
    save_ply(tmp_path / "mip.ply", some_params(), antialiased=True)
    save_ply(tmp_path / "plain.ply", some_params())
    assert is_antialiased(tmp_path / "mip.ply")
    assert not is_antialiased(tmp_path / "plain.ply")


def test_splat_rows_hold_32_bytes_with_the_most_visible_first(tmp_path: Path) -> None:
    params = some_params(3)
    params["scales"] = torch.log(torch.tensor([[0.25], [1.0], [0.5]])).repeat(1, 3)
    params["opacities"] = torch.zeros(3)
    params["quats"] = torch.tensor([[2.0, 0.0, 0.0, 0.0], [0.0, -3.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0]])
    params["sh0"] = torch.tensor([[-9.0, 0.0, 9.0]]).repeat(3, 1)[:, None, :]
    assert save_as(tmp_path / "x.splat", "splat", params) == 96
    data = (tmp_path / "x.splat").read_bytes()
    rows = np.frombuffer(data, [("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rot", "u1", 4)])
    assert np.allclose(rows["scale"][:, 0], [1.0, 0.5, 0.25])
    assert np.array_equal(rows["xyz"], params["means"].numpy()[[1, 2, 0]])
    assert rows["rgba"].tolist() == [[0, 128, 255, 128]] * 3
    assert rows["rot"].tolist() == [[128, 0, 128, 128], [192, 192, 192, 192], [255, 128, 128, 128]]


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("means", lambda x: x.index_fill(0, torch.tensor([2]), math.nan), ("means[2, 0]", "finite")),
        ("opacities", lambda x: x.index_fill(0, torch.tensor([1]), math.inf), ("opacities[1]", "inf")),
        ("quats", lambda x: x.index_fill(0, torch.tensor([3]), 0.0), ("quats[3]", "norm > 0")),
        ("scales", lambda x: x[:, :2], ("scales", "[5, 2]", "[5, 3]")),
        ("shN", lambda x: x[:, :7], ("shN", "[5, 7, 3]")),
    ],
)
def test_bad_parameters_are_named_and_nothing_is_written(tmp_path: Path, name: str, change, words) -> None:
    params = some_params()
    params[name] = change(params[name])
    assert_one_line(lambda: save_ply(tmp_path / "x.ply", params), *words)
    assert_one_line(lambda: save_as(tmp_path / "x.splat", "splat", params), *words)
    assert list(tmp_path.iterdir()) == []


def test_an_absent_parameter_is_named(tmp_path: Path) -> None:
    params = some_params()
    del params["sh0"]
    assert_one_line(lambda: save_ply(tmp_path / "x.ply", params), "sh0")


@given(cut=st.floats(0.0, 0.999))
def test_a_file_cut_anywhere_is_refused_in_one_line(cut: float, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("cut")
    save_ply(folder / "whole.ply", some_params())
    data = (folder / "whole.ply").read_bytes()
    (folder / "cut.ply").write_bytes(data[: int(cut * len(data))])
    assert_one_line(lambda: load_ply(folder / "cut.ply"), str(folder / "cut.ply"))


def test_files_that_are_no_splats_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    assert_one_line(lambda: load_ply(path), str(path), "absent")
    assert_one_line(lambda: load_ply(tmp_path), str(tmp_path))
    path.write_bytes(bytes(range(256)))
    assert_one_line(lambda: load_ply(path), str(path), "corrupt")
    points = np.zeros(2, [(name, "f4") for name in "xyz"])
    PlyData([PlyElement.describe(points, "vertex")]).write(str(path))
    assert_one_line(lambda: load_ply(path), str(path), "'f_dc_0'", "not a splat")
    PlyData([PlyElement.describe(points, "corner")]).write(str(path))
    assert_one_line(lambda: load_ply(path), str(path), "'vertex'")


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [("x", np.nan, ("vertex[1].x", "nan")), ("f_rest_44", np.inf, ("vertex[1].f_rest_44", "inf"))],
)
def test_numbers_that_are_none_are_named_by_row_and_column(tmp_path: Path, column: str, value, words) -> None:
    save_ply(tmp_path / "x.ply", some_params())
    ply = PlyData.read(str(tmp_path / "x.ply"), mmap=False)
    ply["vertex"].data[column][1] = value
    ply.write(str(tmp_path / "x.ply"))
    assert_one_line(lambda: load_ply(tmp_path / "x.ply"), *words)


def test_a_zero_quaternion_in_a_file_is_named(tmp_path: Path) -> None:
    save_ply(tmp_path / "x.ply", some_params())
    ply = PlyData.read(str(tmp_path / "x.ply"), mmap=False)
    for i in range(4):
        ply["vertex"].data[f"rot_{i}"][4] = 0.0
    ply.write(str(tmp_path / "x.ply"))
    assert_one_line(lambda: load_ply(tmp_path / "x.ply"), "vertex[4].rot")


def test_plain_points_are_read_with_and_without_colours(tmp_path: Path) -> None:
    table = np.zeros(2, [*((name, "f8") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))])
    table["x"], table["green"] = [1.5, 2.5], [9, 200]
    PlyData([PlyElement.describe(table, "vertex")], text=True).write(str(tmp_path / "a.ply"))
    xyz, rgb = read_points(tmp_path / "a.ply")
    assert xyz.tolist() == [[1.5, 0.0, 0.0], [2.5, 0.0, 0.0]]
    assert rgb.tolist() == [[0, 9, 0], [0, 200, 0]]
    plain = np.zeros(2, [(name, "f4") for name in "xyz"])
    PlyData([PlyElement.describe(plain, "vertex")]).write(str(tmp_path / "b.ply"))
    assert read_points(tmp_path / "b.ply")[1].tolist() == [[128] * 3] * 2


# PLY headers that promise what the file does not hold: refused in one line before a row is read.

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


# Plain points from PLY: colours as any program stores them, headers in any language.


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
