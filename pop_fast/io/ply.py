"""Read and write PLY: point clouds, and splats in the layout of the 3DGS reference code, which every viewer opens.

One row a Gaussian, little-endian float32: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_0..44, opacity, scale_0..2,
rot_0..3. Opacities are logits, scales logarithms, rotations wxyz of any norm; f_rest is channel-major: fifteen
coefficients of red, then green, then blue. A header comment `SplatRenderMode: mip` marks antialiased splats, and one
`pop-frame:` says which world they are in, as an object of JSON does in other formats.

A header is a promise that anybody can write: so many rows of so many bytes. It is held against the grammar and the
file's size before a row is read. Rows of fixed size are read as one block; the few files of other kinds (ASCII, or
lists in or before the vertices) go row by row through plyfile, from memory: a file that is mapped can still end the
process, by what its header says or because somebody shortens it.
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_file
from pop_fast.io.read_back import check_memory

if TYPE_CHECKING:
    import torch

_SHAPES = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
MODE = "SplatRenderMode:"
# sigmoid(logit) >= 1/255, what a renderer can show at all
_VISIBLE_LOGIT = -np.log(254.0)
_COLUMNS = (
    ["x", "y", "z", "nx", "ny", "nz"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity"]
    + [f"scale_{i}" for i in range(3)]
    + [f"rot_{i}" for i in range(4)]
)


def save_ply(
    path: str | os.PathLike[str],
    params: Mapping[str, torch.Tensor | np.ndarray],
    antialiased: bool = False,
    drop_transparent: bool = False,
    frame: Frame | None = None,
) -> tuple[int, int]:
    """Write raw parameters as PLY, atomically.

    Args:
        path: the file to write.
        params: means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 0|3|8|15, 3], raw;
            tensors or arrays.
        antialiased: the splats were trained with antialiasing, and are to be drawn so.
        drop_transparent: leave out Gaussians with an opacity under 1/255, which no renderer shows.
        frame: the world that they are in, where it is known; written as a comment.

    Returns:
        The number of Gaussians before and after that filter.

    Raises:
        PopError: a parameter is absent, of the wrong shape, NaN or Inf, a quaternion is zero, or the file cannot be
            written.
    """
    arrays = checked_params(params)
    before = len(arrays["means"])
    if drop_transparent:
        visible = arrays["opacities"] >= _VISIBLE_LOGIT
        arrays = {name: array[visible] for name, array in arrays.items()}
    write_file(path, _file(arrays, antialiased, frame))
    return before, len(arrays["means"])


def ply_bytes(
    params: Mapping[str, torch.Tensor | np.ndarray], antialiased: bool = False, frame: Frame | None = None
) -> bytes:
    return _file(checked_params(params), antialiased, frame)


def _file(arrays: dict[str, np.ndarray], antialiased: bool, frame: Frame | None) -> bytes:
    n = len(arrays["means"])
    rest = np.zeros((n, 15, 3), np.float32)
    rest[:, : arrays["shN"].shape[1]] = arrays["shN"]
    columns = [
        arrays["means"],
        np.zeros((n, 3), np.float32),
        arrays["sh0"].reshape(n, 3),
        rest.transpose(0, 2, 1).reshape(n, 45),
        arrays["opacities"][:, None],
        arrays["scales"],
        arrays["quats"],
    ]
    table = np.ascontiguousarray(np.concatenate(columns, axis=1), dtype="<f4")
    return header_bytes(antialiased, frame, ("vertex", n, "float", _COLUMNS)) + table.tobytes()


def header_bytes(antialiased: bool, frame: Frame | None, *elements: tuple[str, int, str, Sequence[str]]) -> bytes:
    """Return a header; an element is its name, the number of its rows, their type and the names of its columns."""
    lines = ["ply", "format binary_little_endian 1.0", f"comment {MODE} {'mip' if antialiased else 'default'}"]
    lines += [] if frame is None else [f"comment {comment}" for comment in frame.comments()]
    for name, n, kind, columns in elements:
        lines += [f"element {name} {n}", *(f"property {kind} {column}" for column in columns)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def load_ply(path: str | os.PathLike[str]) -> dict[str, torch.Tensor]:
    """Read splats from a PLY file: columns by name, in any order, among any others.

    Normals are ignored; f_rest may be absent or of a lower degree (0, 9, 24 or 45 columns) and is padded with zeros.

    Returns:
        means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 15, 3]; raw, float32.

    Raises:
        PopError: the file is absent, truncated or corrupt, is no splat, or holds NaN, Inf or a zero quaternion.
    """
    path = Path(path)
    return _params(read_vertices(path), path)


def params_of_ply(data: bytes, path: Path) -> dict[str, torch.Tensor]:
    """Read splats from a PLY file's bytes; see `load_ply`."""
    return _params(vertices_of(data, path), path)


def _params(rows: np.ndarray, path: Path) -> dict[str, torch.Tensor]:
    names = set(rows.dtype.names or ())
    needed = [c for c in _COLUMNS if not c.startswith(("n", "f_rest"))]
    absent = [name for name in needed if name not in names]
    if absent:
        raise PopError(f"{path}: vertex has no property {absent[0]!r}; it is not a splat as 3DGS writes it")
    count = sum(name.startswith("f_rest_") for name in names)
    if count not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(count)):
        raise PopError(f"{path}: vertex has {count} f_rest properties; there must be 0, 9, 24 or 45, without a gap")

    def columns(*wanted: str) -> np.ndarray:
        stacked = np.stack([column(path, rows, name, np.float32) for name in wanted], axis=1)
        bad = np.argwhere(~np.isfinite(stacked))
        if len(bad):
            row, which = (int(i) for i in bad[0])
            raise PopError(f"{path}: vertex[{row}].{wanted[which]} is {stacked[row, which]}; it must be finite")
        return stacked

    n = len(rows)
    rest = np.zeros((n, 15, 3), np.float32)
    if count:
        rest[:, : count // 3] = (
            columns(*(f"f_rest_{i}" for i in range(count))).reshape(n, 3, count // 3).transpose(0, 2, 1)
        )
    quats = columns(*(f"rot_{i}" for i in range(4)))
    if n and not quats.any(axis=1).all():
        row = int(np.argmin(quats.any(axis=1)))
        raise PopError(f"{path}: vertex[{row}].rot is a zero quaternion; write [1, 0, 0, 0] for no rotation")
    arrays = {
        "means": columns("x", "y", "z"),
        "scales": columns(*(f"scale_{i}" for i in range(3))),
        "quats": quats,
        "opacities": columns("opacity")[:, 0],
        "sh0": columns(*(f"f_dc_{i}" for i in range(3)))[:, None, :],
        "shN": rest,
    }
    # headers and points are read without torch
    import torch

    return {name: torch.from_numpy(np.ascontiguousarray(array)) for name, array in arrays.items()}


def asks_for_antialiasing(header: Header) -> bool:
    """Tell whether a header has the comment `SplatRenderMode: mip`."""
    return any(comment.startswith(MODE) and comment.split()[-1] == "mip" for comment in header.comments)


def frame_of(path: str | os.PathLike[str]) -> Frame | None:
    """Tell which world a PLY file's splats are in, by its comment; None where there is none, as of other programs."""
    return Frame.of_comments(read_header(Path(path)).comments, Path(path))


def checked_params(params: Mapping[str, torch.Tensor | np.ndarray]) -> dict[str, np.ndarray]:
    """Return raw parameters as float32 arrays.

    Raises:
        PopError: one is absent, of the wrong shape, NaN or Inf, or a quaternion is zero; names the entry.
    """
    arrays: dict[str, np.ndarray] = {}
    for name in (*_SHAPES, "shN"):
        if name not in params:
            raise PopError(f"params has no {name!r}; a splat needs {', '.join(_SHAPES)} and shN")
        values = params[name]
        found = values if isinstance(values, np.ndarray) else values.detach().cpu().numpy()
        arrays[name] = found.astype(np.float32, copy=False)
    n = len(arrays["means"])
    for name, array in arrays.items():
        bands = array.shape[1] if name == "shN" and array.ndim == 3 and array.shape[1] in (0, 3, 8, 15) else 15
        want = (n, *_SHAPES.get(name, (bands, 3)))
        if array.shape != want:
            raise PopError(f"{name} has shape {list(array.shape)}; it must be {list(want)}")
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            index = tuple(int(i) for i in bad[0])
            raise PopError(f"{name}{list(index)} is {array[index]}; every parameter must be finite")
    norms = np.abs(arrays["quats"]).sum(axis=1)
    if n and norms.min() == 0.0:
        raise PopError(f"quats[{int(np.argmin(norms))}] is zero; every quaternion must have a norm > 0")
    return arrays


_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_SIGNED: Final = {"char": "i1", "short": "i2", "int": "i4", "float": "f4", "double": "f8"}
_UNSIGNED: Final = {"uchar": "u1", "ushort": "u2", "uint": "u4"}
_WITH_BITS: Final = {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS: Final = _SIGNED | _UNSIGNED | _WITH_BITS | {"float32": "f4", "float64": "f8"}
# comments apart, a splat's header has 2 kB
_LONGEST: Final = 2**20


@dataclass
class Element:
    """A kind of rows: name and type of each property, or the type of a list's length where it is a list."""

    name: str
    count: int
    columns: list[tuple[str, str]]
    lists: bool = False


@dataclass(frozen=True)
class Header:
    """What a PLY file says of itself."""

    order: str  # "<" or ">" of a binary file, "" of an ASCII one
    elements: tuple[Element, ...]  # in the order of their rows
    comments: tuple[str, ...]  # without the word "comment"
    length: int  # bytes up to the first row


def read_header(path: Path) -> Header:
    """Read the header alone; a PopError says that it is absent or cut off, or names the line that breaks a rule."""
    return header_of(file_bytes(path, "PLY file", _LONGEST), path)


def file_bytes(path: Path, what: str = "file", most: int = -1) -> bytes:
    """Return a file's bytes, or so many from its beginning; a PopError says that it is absent or cannot be read."""
    try:
        with open(path, "rb") as file:
            if most < 0:
                size = os.fstat(file.fileno()).st_size
                check_memory(path, size, size, f"the {what}", "crop or thin it out first")
            return file.read(most)
    except FileNotFoundError:
        raise PopError(f"{path}: the {what} is absent; check the path") from None
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check the path and its permissions") from error


def header_of(data: bytes, path: Path) -> Header:
    """Read the header at the beginning of a file's bytes."""
    try:
        return _parse(data[:_LONGEST])
    except ValueError as error:
        raise PopError(f"{path}: the PLY file is truncated or corrupt: {error}; copy or write it again") from error


def read_vertices(path: Path) -> np.ndarray:
    """Return the rows of the element `vertex`, read-only, with a field for each property.

    Raises:
        PopError: as `read_header`; or the file has no vertices as element, or fewer rows than its header says.
    """
    # a file that is no splat is recognised by its beginning
    _vertex_elements(read_header(path), path)
    return vertices_of(file_bytes(path), path)


def vertices_of(data: bytes, path: Path) -> np.ndarray:
    """Return the rows of the element `vertex` of a file's bytes; see `read_vertices`."""
    header = header_of(data, path)
    read = _vertex_elements(header, path)
    try:
        _check_size(header, len(data))
        if header.order and not any(element.lists for element in read):
            return _block(header, read, data)
        return _row_by_row(header, data)
    except (ValueError, IndexError, OverflowError, MemoryError, TypeError) as error:
        raise PopError(f"{path}: the PLY file is truncated or corrupt: {error}; copy or write it again") from error


def _vertex_elements(header: Header, path: Path) -> tuple[Element, ...]:
    """Return the elements up to `vertex`."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise PopError(f"{path}: has no element 'vertex'; it is not a point cloud or a splat")
    return header.elements[: names.index("vertex") + 1]


def column(path: Path, rows: np.ndarray, name: str, kind: type) -> np.ndarray:
    """Return one property of all rows as numbers of a type; a PopError says that it is a list."""
    if rows.dtype[name].kind == "O":
        raise PopError(f"{path}: vertex.{name} is a list; it must be one number a vertex")
    return rows[name].astype(kind)


def _row_by_row(header: Header, data: bytes) -> np.ndarray:
    # not at the top: what this program writes itself is read without it
    from plyfile import PlyData, PlyParseError

    # it reads headers as ASCII, and comments are written in any language
    head = bytes(byte if byte < 128 else ord("?") for byte in data[: header.length])
    try:
        return PlyData.read(io.BytesIO(head + data[header.length :]))["vertex"].data
    except PlyParseError as error:
        raise ValueError(str(error)) from error


def _block(header: Header, read: tuple[Element, ...], data: bytes) -> np.ndarray:
    at, rows = header.length, np.empty(0)
    for element in read:
        kind = np.dtype([(name, header.order + column) for name, column in element.columns])
        rows = np.frombuffer(data, kind, element.count, at)
        at += rows.nbytes
    return rows


def _check_size(header: Header, size: int) -> None:
    """Raise ValueError when the file cannot hold what its header says."""
    least = 0
    for element in header.elements:
        # in ASCII a number takes a digit and what ends it; the file's last one may have no end
        widths = [np.dtype(kind).itemsize if header.order else 2 for _, kind in element.columns]
        least += element.count * sum(widths)
    least -= 0 if header.order else 1
    if least > size - header.length:
        rows = ", ".join(f"{element.count} of {element.name}" for element in header.elements)
        raise ValueError(f"{size - header.length} bytes after the header cannot be its rows ({rows})")


def _parse(head: bytes) -> Header:
    ends = [end for end in (b"\r\n", b"\n", b"\r") if head.startswith(b"ply" + end)]
    if not ends:
        raise ValueError("it does not begin with the line 'ply'")
    text, found, _ = head.partition(ends[0] + b"end_header" + ends[0])
    if not found:
        raise ValueError("its header has no end")
    order: str | None = None
    elements: list[Element] = []
    comments: list[str] = []
    for number, line in enumerate(text.split(ends[0])[1:], start=2):
        words = line.decode("ascii", "replace").split()
        match words:
            case ["format", kind, "1.0"] if kind in _ORDERS and order is None and not elements:
                order = _ORDERS[kind]
            case ["comment" | "obj_info", *rest]:
                comments.append(" ".join(rest))
            case ["element", name, count] if order is not None and re.fullmatch(r"[0-9]{1,18}", count):
                elements.append(Element(name, int(count), []))
            case ["property", kind, name] if elements and kind in _KINDS:
                elements[-1].columns.append((name, _KINDS[kind]))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= _KINDS.keys():
                elements[-1].columns.append((name, _KINDS[length]))
                elements[-1].lists = True
            case []:
                pass
            case _:
                raise ValueError(f"line {number} of its header, {' '.join(words)[:60]!r}, is not what PLY allows there")
    if order is None:
        raise ValueError("its header names no format")
    for element in elements:
        names = [name for name, _ in element.columns]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"element {element.name!r} has {'two properties of a name' if names else 'no properties'}")
    return Header(order, tuple(elements), tuple(comments), len(text) + len(found))


# the square of a distance must stay a number in single precision, and a scene of this size is a corrupt file
FARTHEST = 1e15
# a float colour may lie a little over 1 without being one of those up to 255
_BRIGHTEST = 2.0


def find_bad_coordinate(xyz: np.ndarray) -> tuple[int, int] | None:
    """Find the first coordinate that is NaN, Inf or beyond `FARTHEST`: its row and axis, or None. xyz: [P, 3]"""
    bad = np.argwhere(~(np.abs(xyz) <= FARTHEST))
    return (int(bad[0, 0]), int(bad[0, 1])) if len(bad) else None


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions float64 [P, 3] and colours uint8 [P, 3] (mid-gray where the file has none).

    Colours are stored as floats in [0, 1], or as numbers up to 255 or up to 65535; the largest tells which.

    Raises:
        PopError: as `read_vertices`; a coordinate is absent, NaN, Inf or absurd, or a colour is none of these.
    """
    rows = read_vertices(path)
    names = rows.dtype.names or ()
    for name in "xyz":
        if name not in names:
            raise PopError(f"{path}: vertex has no property {name!r}; a point cloud needs x, y and z")
    xyz = np.stack([column(path, rows, name, np.float64) for name in "xyz"], axis=1)
    bad = find_bad_coordinate(xyz)
    if bad is not None:
        row, axis = bad
        raise PopError(
            f"{path}: vertex[{row}].{'xyz'[axis]} is {xyz[row, axis]}; every coordinate must be finite and within "
            f"{FARTHEST:.0e}"
        )
    if not {"red", "green", "blue"} <= set(names):
        return xyz, np.full((len(xyz), 3), 128, np.uint8)
    return xyz, _colors(path, rows)


def _colors(path: Path, rows: np.ndarray) -> np.ndarray:
    names = ("red", "green", "blue")
    fractions = any(rows.dtype[name].kind == "f" for name in names)
    rgb = np.stack([column(path, rows, name, np.float64) for name in names], axis=1)
    bad = np.argwhere(~((rgb >= 0.0) & (rgb <= 65535.0)))
    if len(bad):
        row, which = (int(i) for i in bad[0])
        raise PopError(
            f"{path}: vertex[{row}].{names[which]} is {rgb[row, which]:g}; a colour must be in [0, 1], up to 255 or up "
            "to 65535"
        )
    largest = rgb.max(initial=0.0)
    if fractions and largest <= _BRIGHTEST:
        rgb = 255.0 * np.minimum(rgb, 1.0)
    elif largest > 255.0:
        rgb /= 257.0
    return np.rint(rgb).astype(np.uint8)


# what the comments of a PLY's header begin with, and the name of the object in JSON
COMMENT: Final = "pop-frame:"
_DRAWN: Final = "pop-drawn:"
KEY: Final = "pop_frame"
# settings of a training that a splat is drawn by
DRAWN_BY: Final = ("profile", "near_plane", "eps2d")


@dataclass(frozen=True)
class Frame:
    """The world that a splat is in, and how it is drawn there."""

    # "capture" is the capture's own, "training" the one that `pop train` moves it into
    name: Literal["capture", "training"]
    # similarity, training frame = transform @ capture's own frame; None where it is not known. [4, 4]
    transform: tuple[tuple[float, ...], ...] | None = None
    # of `DRAWN_BY`, what is not as usual; the near plane is one of the training frame
    drawn: tuple[tuple[str, str | float], ...] = ()

    @classmethod
    def of_training(cls, transform: Any, drawn: tuple[tuple[str, str | float], ...] = ()) -> Frame:
        """Return the frame of a training that a similarity, an array [4, 4], moved, or that None left where it was."""
        rows = None if transform is None else tuple(map(tuple, transform.tolist()))
        return cls("capture" if rows is None else "training", rows, drawn)

    def comments(self) -> list[str]:
        """Return the comments of a PLY's header, without the word "comment"."""
        rows = () if self.transform is None else self.transform
        world = " ".join([COMMENT, self.name, *(f"{x:.17g}" for row in rows for x in row)])
        return [world, *([f"{_DRAWN} {json.dumps(dict(self.drawn))}"] if self.drawn else [])]

    def entry(self) -> dict[str, Any]:
        """Return what JSON holds under the name `KEY`."""
        moved = {} if self.transform is None else {"transform": self.transform}
        return {"name": self.name, **moved, **({"drawn": dict(self.drawn)} if self.drawn else {})}

    @classmethod
    def of_comments(cls, comments: Sequence[str], path: Path) -> Frame | None:
        """Read the frame from the comments of a PLY's header; None where they have none, as of other programs."""
        found: Frame | None = None
        for comment in comments:
            sound = True
            if comment.startswith(COMMENT) and found is None:
                name, *numbers = comment.removeprefix(COMMENT).split() or [""]
                found = cls._checked(name, numbers or None)
                sound = found is not None
            elif comment.startswith(_DRAWN) and found is not None:
                drawn = _settings(comment.removeprefix(_DRAWN))
                found, sound = replace(found, drawn=drawn or ()), drawn is not None
            if not sound:
                raise PopError(f"{path}: comment {comment[:60]!r} is damaged; remove it, or export the splat again")
        return found

    @classmethod
    def of_entry(cls, holder: Any, path: Path) -> Frame | None:
        """Read the frame from an object of JSON that may hold it under the name `KEY`; None where it does not."""
        if not isinstance(holder, Mapping) or KEY not in holder:
            return None
        entry = holder[KEY]
        found = cls._checked(entry.get("name"), entry.get("transform")) if isinstance(entry, Mapping) else None
        drawn = None if found is None else _settings(entry.get("drawn", {}))
        if found is None or drawn is None:
            raise PopError(f"{path}: {KEY} is {str(entry)[:60]!r}, which is damaged; export the splat again")
        return replace(found, drawn=drawn)

    @classmethod
    def _checked(cls, name: Any, numbers: Any) -> Frame | None:
        """Return the frame of a name and of 16 numbers or none, in rows or not; None where they make no frame."""
        if name not in ("capture", "training"):
            return None
        if numbers is None:
            return cls(name)
        try:
            values = np.array(numbers, np.float64).reshape(4, 4)
            # what cannot be undone moves nothing back
            sound = np.isfinite(values).all() and np.isfinite(np.linalg.inv(values)).all()
        except (ValueError, TypeError, OverflowError, np.linalg.LinAlgError):
            return None
        return cls(name, tuple(map(tuple, values.tolist()))) if sound else None


def _settings(said: Any) -> tuple[tuple[str, str | float], ...] | None:
    """Return what an object, or the JSON of one, says of how a splat is drawn; None where it is damaged."""
    try:
        entries = json.loads(said) if isinstance(said, str) else said
    except (ValueError, RecursionError):
        return None
    if not isinstance(entries, Mapping):
        return None
    drawn = tuple((name, entries[name]) for name in DRAWN_BY if name in entries)
    kinds = all(type(value) in ((str,) if name == "profile" else (int, float)) for name, value in drawn)
    # a whole number of hundreds of digits is no float
    return drawn if kinds and all(isinstance(value, str) or abs(value) < 1e300 for _, value in drawn) else None
