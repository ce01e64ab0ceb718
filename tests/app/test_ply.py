"""Splats survive PLY bit for bit, in the layout that other programs read; damaged files are refused in one line."""

from __future__ import annotations

import math
import os
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
from pop_fast.io.formats import decoded, encoded, load_splat_file, save_as
from pop_fast.io.ply import asks_for_antialiasing, load_ply, read_header, read_points, save_ply
from tests.app.captures import assert_one_line, many
from tests.app.conftest import pop_in_a_child
from tests.app.damage import says

ANY = {"allow_nan": False, "allow_infinity": False, "width": 32}


def assert_same_bits(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype == torch.float32
        assert a[name].shape == b[name].shape
        assert torch.equal(a[name].view(torch.int32), b[name].view(torch.int32)), name


def write_ply(path: Path, rows: np.ndarray, name: str = "vertex", **options: object) -> Path:
    PlyData([PlyElement.describe(rows, name)], **options).write(str(path))
    return path


@given(table=st.integers(0, 4).flatmap(lambda n: hnp.arrays(np.float32, (n, 59), elements=st.floats(**ANY))))
def test_a_round_trip_keeps_every_bit(table: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> None:
    table = table.copy()
    table[:, 3] = np.where(table[:, 3:7].any(axis=1), table[:, 3], 1.0)
    n, shapes = len(table), {"opacities": (-1,), "sh0": (-1, 1, 3), "shN": (-1, 15, 3)}
    ends = {
        "means": (0, 3),
        "quats": (3, 7),
        "scales": (7, 10),
        "opacities": (10, 11),
        "sh0": (11, 14),
        "shN": (14, 59),
    }
    columns = {name: torch.from_numpy(table[:, a:b].copy()) for name, (a, b) in ends.items()}
    params = {name: value.reshape(n, *shapes.get(name, value.shape)[1:]) for name, value in columns.items()}
    path = tmp_path_factory.mktemp("ply") / "x.ply"
    assert save_ply(path, params) == (n, n)
    assert_same_bits(load_ply(path), params)


def test_numpy_arrays_are_written_as_tensors_are(tmp_path: Path) -> None:
    params = many(3)
    save_ply(tmp_path / "tensors.ply", params)
    save_ply(tmp_path / "arrays.ply", {name: value.numpy() for name, value in params.items()})
    assert (tmp_path / "arrays.ply").read_bytes() == (tmp_path / "tensors.ply").read_bytes()


def test_the_file_is_laid_out_as_the_reference_code_lays_it_out(tmp_path: Path) -> None:
    params = many(2)
    save_ply(tmp_path / "x.ply", params)
    header, body = (tmp_path / "x.ply").read_bytes().split(b"end_header\n")
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert header.decode().splitlines() == [
        *("ply", "format binary_little_endian 1.0", "comment SplatRenderMode: default", "element vertex 2"),
        *(f"property float {name}" for name in names),
    ]
    assert len(body) == 2 * 248
    rows = np.frombuffer(body, "<f4").reshape(2, 62)
    assert np.array_equal(rows[:, 3:6], np.zeros((2, 3)))
    # channel-major: the fifteen red coefficients first
    assert np.array_equal(rows[:, 9:24], params["shN"][:, :, 0].numpy())
    assert np.array_equal(rows[:, 24:39], params["shN"][:, :, 1].numpy())
    assert np.array_equal(rows[:, 54], params["opacities"].numpy())
    assert not asks_for_antialiasing(read_header(tmp_path / "x.ply"))
    save_ply(tmp_path / "mip.ply", params, antialiased=True)
    assert asks_for_antialiasing(read_header(tmp_path / "mip.ply"))


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_columns_are_found_by_name_in_any_order_among_others(tmp_path: Path, text: bool, byte_order: str) -> None:
    params = many(3)
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
    params = many(3, bands)
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
    assert_same_bits(load_ply(write_ply(tmp_path / "b.ply", few)), padded)


def test_transparent_gaussians_are_left_out_on_request_and_counted(tmp_path: Path) -> None:
    params = many(4)
    params["opacities"] = torch.tensor([math.log(1.01 / 253.99), math.log(0.99 / 254.01), -20.0, 3.0])
    assert save_ply(tmp_path / "all.ply", params) == (4, 4)
    assert save_ply(tmp_path / "few.ply", params, drop_transparent=True) == (4, 2)
    assert_same_bits(load_ply(tmp_path / "few.ply"), {name: value[[0, 3]] for name, value in params.items()})


def test_splat_rows_hold_32_bytes_with_the_most_visible_first(tmp_path: Path) -> None:
    params = many(3)
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


def test_a_scale_too_small_for_a_float_is_read_back_from_splat_rows_and_one_below_0_is_refused() -> None:
    params = many(3)
    params["scales"][1] = torch.tensor([-3.0, -200.0, -300.0])
    data = encoded("splat", params)
    assert float(decoded("splat", data).params["scales"].min()) == pytest.approx(-150.0 * math.log(2.0))
    with pytest.raises(PopError, match=r"scale of Gaussian 0 is \[-1.0, .*; it must be 0 or more"):
        decoded("splat", data[:12] + struct.pack("<f", -1.0) + data[16:])


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("means", lambda x: x.index_fill(0, torch.tensor([2]), math.nan), ("means[2, 0]", "finite")),
        ("opacities", lambda x: x.index_fill(0, torch.tensor([1]), math.inf), ("opacities[1]", "inf")),
        ("quats", lambda x: x.index_fill(0, torch.tensor([3]), 0.0), ("quats[3]", "norm > 0")),
        ("scales", lambda x: x[:, :2], ("scales", "[5, 2]", "[5, 3]")),
        ("shN", lambda x: x[:, :7], ("shN", "[5, 7, 3]")),
        ("sh0", None, ("sh0",)),
    ],
)
def test_bad_parameters_are_named_and_nothing_is_written(tmp_path: Path, name: str, change, words) -> None:
    params = many(5)
    value = params.pop(name)
    params |= {name: change(value)} if change else {}
    assert_one_line(lambda: save_ply(tmp_path / "x.ply", params), *words)
    assert_one_line(lambda: save_as(tmp_path / "x.splat", "splat", params), *words)
    assert list(tmp_path.iterdir()) == []


@given(cut=st.floats(0.0, 0.999))
def test_a_file_cut_anywhere_is_refused_in_one_line(cut: float, tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("cut")
    save_ply(folder / "whole.ply", many(5))
    data = (folder / "whole.ply").read_bytes()
    (folder / "cut.ply").write_bytes(data[: int(cut * len(data))])
    assert_one_line(lambda: load_ply(folder / "cut.ply"), str(folder / "cut.ply"))


def test_files_that_are_no_splats_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.ply"
    assert_one_line(lambda: load_ply(path), str(path), "absent")
    assert_one_line(lambda: load_ply(tmp_path), str(tmp_path))
    assert_one_line(lambda: read_points(tmp_path), "could not be read: Is a directory")
    path.write_bytes(bytes(range(256)))
    assert_one_line(lambda: load_ply(path), str(path), "corrupt")
    points = np.zeros(2, [(name, "f4") for name in "xyz"])
    assert_one_line(lambda: load_ply(write_ply(path, points)), str(path), "'f_dc_0'", "not a splat")
    assert_one_line(lambda: load_ply(write_ply(path, points, "corner")), str(path), "'vertex'")


@pytest.mark.parametrize(
    ("columns", "value", "words"),
    [
        (["x"], np.nan, ("vertex[1].x", "nan")),
        (["f_rest_44"], np.inf, ("vertex[1].f_rest_44", "inf")),
        ([f"rot_{i}" for i in range(4)], 0.0, ("vertex[1].rot",)),
    ],
    ids=["nan", "inf", "zero quaternion"],
)
def test_numbers_that_are_none_are_named_by_row_and_column(tmp_path: Path, columns: list[str], value, words) -> None:
    save_ply(tmp_path / "x.ply", many(5))
    ply = PlyData.read(str(tmp_path / "x.ply"), mmap=False)
    for column in columns:
        ply["vertex"].data[column][1] = value
    ply.write(str(tmp_path / "x.ply"))
    assert_one_line(lambda: load_ply(tmp_path / "x.ply"), *words)


@pytest.mark.parametrize("name", ["splat", "gltf", "spz", "compressed-ply"])
@pytest.mark.filterwarnings("error")
def test_a_size_that_no_number_of_a_file_can_be_is_its_largest(name: str) -> None:
    params = many(3)
    params["scales"][1, 2] = 300.0
    back = decoded(name, encoded(name, params)).params["scales"]
    assert back.isfinite().all()
    assert 5.0 < back.amax() < 89.0


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_a_file_larger_than_memory_is_named(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    save_as(path, ending, many(3))
    os.truncate(path, 2**40)
    assert_one_line(lambda: load_splat_file(path), f"{path}: the file would take", "are free; crop or thin it out")


def test_what_stands_behind_the_rows_is_not_read(tmp_path: Path) -> None:
    save_ply(tmp_path / "x.ply", many(5))
    with open(tmp_path / "x.ply", "ab") as file:
        file.write(b"more")
    assert_same_bits(load_ply(tmp_path / "x.ply"), many(5))


# PLY headers that promise what the file does not hold: refused in one line before a row is read.

XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(path: Path, elements: str, rows: bytes = b"", format: str = "binary_little_endian") -> Path:
    path.write_bytes(f"ply\nformat {format} 1.0\n{elements}end_header\n".encode() + rows)
    return path


def test_a_header_that_ended_the_interpreter_is_a_sentence(tmp_path: Path) -> None:
    path = ply(tmp_path / "x.ply", f"element foo -1\nelement vertex 1\n{XYZ}", bytes(12))
    says(pop_in_a_child("export", path, "--out", tmp_path / "o.splat"), "x.ply", "'element foo -1'", "write it again")
    assert not (tmp_path / "o.splat").exists()


@pytest.mark.parametrize(
    ("elements", "rows", "words"),
    [
        (f"element foo -1\nelement vertex 1\n{XYZ}", 12, ("line 3", "'element foo -1'")),
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
    ids=range(15),
)
def test_a_promise_that_is_not_kept_is_named(elements: str, rows: int, words: tuple[str, ...], tmp_path: Path) -> None:
    path = ply(tmp_path / "x.ply", elements, bytes(rows))
    assert_one_line(lambda: read_points(path), "x.ply", "truncated or corrupt", *words)
    assert_one_line(lambda: load_ply(path), "x.ply", *words)


def test_rows_of_text_that_are_promised_need_room_and_their_numbers_are_held_to_a_range(tmp_path: Path) -> None:
    path = ply(tmp_path / "x.ply", f"element vertex 100000000\n{XYZ}", b"0 0 0\n", "ascii")
    assert_one_line(lambda: read_points(path), "cannot be its rows (100000000 of vertex)")
    ply(path, f"element vertex 1\n{XYZ}", b"0 0 0", "ascii")
    assert read_points(path)[0].tolist() == [[0.0, 0.0, 0.0]]
    ply(path, f"element vertex 1\n{XYZ.replace('float', 'double')}", b"0 1e200 0\n", "ascii")
    assert_one_line(lambda: read_points(path), "x.ply", "vertex[0].y is 1e+200", "within 1e+15")


@pytest.mark.parametrize("name", ["x", "rot_2", "f_rest_7", "red"])
def test_a_list_under_the_name_of_a_number_is_named(name: str, tmp_path: Path) -> None:
    columns = [*"xyz", "red", "green", "blue", "opacity", *(f"f_dc_{i}" for i in range(3))]
    columns += [*(f"f_rest_{i}" for i in range(9)), *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    lines = "".join(f"property {'list uchar ' if c == name else ''}float {c}\n" for c in columns)
    row = b"".join((b"\1" if c == name else b"") + struct.pack("<f", 0.5) for c in columns)
    path = ply(tmp_path / "x.ply", f"element vertex 1\n{lines}", row)
    reader = read_points if name == "red" else load_ply
    assert_one_line(lambda: reader(path), f"x.ply: vertex.{name} is a list; it must be one number a vertex")


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_lines_may_end_in_any_way(end: str, order: str, tmp_path: Path) -> None:
    elements = f"comment SplatRenderMode: mip\n\nelement vertex 1\n{XYZ}"
    header = ply(tmp_path / "x.ply", elements, format=f"binary_{order}_endian").read_text()
    rows = struct.pack("<3f" if order == "little" else ">3f", 1.0, 2.0, 13.0)
    (tmp_path / "x.ply").write_bytes(header.replace("\n", end).encode() + rows)
    assert read_points(tmp_path / "x.ply")[0].tolist() == [[1.0, 2.0, 13.0]]
    assert asks_for_antialiasing(read_header(tmp_path / "x.ply"))


def test_faces_before_and_behind_the_vertices_do_no_harm(tmp_path: Path) -> None:
    points = np.array([(1.0, 2.0, 3.0)], [(n, "f4") for n in "xyz"])
    faces = np.empty(2, [("vertex_indices", object)])
    faces["vertex_indices"] = [np.array([0, 0, 0], "i4"), np.array([0, 0, 0, 0], "i4")]
    vertex, face = PlyElement.describe(points, "vertex"), PlyElement.describe(faces, "face")
    for elements in ([vertex, face], [face, vertex]):
        PlyData(elements).write(str(tmp_path / "x.ply"))
        xyz, rgb = read_points(tmp_path / "x.ply")
        # gray where the file has no colours
        assert (xyz.tolist(), rgb.tolist()) == ([[1.0, 2.0, 3.0]], [[128] * 3])


# Plain points from PLY: colours as any program stores them, headers in any language.


def colored(path: Path, kind: str, colors: np.ndarray | list[float], text: bool = False) -> Path:
    """Write points (i, 0, 0) with the same number for red, green and blue."""
    rows = np.zeros(len(colors), [*((n, "f8") for n in "xyz"), *((n, kind) for n in ("red", "green", "blue"))])
    rows["x"] = range(len(colors))
    for name in ("red", "green", "blue"):
        rows[name] = colors
    return write_ply(path, rows, text=text)


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
def test_colours_of_any_kind_are_read(tmp_path: Path, kind: str, stored: list[float], read: list, text: bool) -> None:
    xyz, rgb = read_points(colored(tmp_path / "p.ply", kind, stored, text))
    assert xyz.tolist() == [[float(i), 0.0, 0.0] for i in range(4)]
    assert rgb.dtype == np.uint8
    assert rgb.tolist() == [[value] * 3 for value in read]


def test_each_colour_is_read_from_its_own_column(tmp_path: Path) -> None:
    rows = np.zeros(1, [*((n, "f4") for n in "xyz"), *((n, "u1") for n in ("blue", "red", "green"))])
    rows["green"] = 9
    assert read_points(write_ply(tmp_path / "p.ply", rows))[1].tolist() == [[0, 9, 0]]


@pytest.mark.parametrize(("kind", "stored"), [("f4", np.nan), ("f4", np.inf), ("f4", -0.5), ("i4", -1), ("i4", 70_000)])
def test_a_colour_that_is_none_is_named_without_a_warning(tmp_path: Path, kind: str, stored: float) -> None:
    path = colored(tmp_path / "p.ply", kind, [0, stored])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_one_line(lambda: read_points(path), "p.ply", f"vertex[1].red is {stored:g}", "65535")


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_comments_in_any_language_do_no_harm(tmp_path: Path, text: bool, encoding: str) -> None:
    path = colored(tmp_path / "p.ply", "u1", [10, 13, 200, 255], text)
    head, first, rest = path.read_bytes().partition(b"element")
    path.write_bytes(head + "comment end_header für Küche\n".encode(encoding) + first + rest)
    xyz, rgb = read_points(path)
    assert xyz.shape == (4, 3)
    assert rgb[:, 0].tolist() == [10, 13, 200, 255]
