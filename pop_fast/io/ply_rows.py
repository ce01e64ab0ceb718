"""Read a PLY file's header, and the rows of its element `vertex`: ASCII or binary of either byte order.

The header is a promise that anybody can write: so many rows of so many bytes. It is held against the grammar and the
file's size before a row is read. Rows of fixed size are read as one block; the few files of other kinds (ASCII, or
lists in or before the vertices) go row by row through plyfile, from memory: a file that is mapped can still end the
process, by what its header says or because somebody shortens it.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.errors import PopError

_ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_SIGNED: Final = {"char": "i1", "short": "i2", "int": "i4", "float": "f4", "double": "f8"}
_UNSIGNED: Final = {"uchar": "u1", "ushort": "u2", "uint": "u4"}
_WITH_BITS: Final = {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_KINDS: Final = _SIGNED | _UNSIGNED | _WITH_BITS | {"float32": "f4", "float64": "f8"}
# comments apart, a splat's header has 2 kB
_LONGEST: Final = 2**20


@dataclass
class Element:
    """A kind of rows.

    Attributes:
        name: for example "vertex".
        count: rows.
        columns: name and type of each property; the type of a list's length where it is a list.
        lists: whether a property is a list.
    """

    name: str
    count: int
    columns: list[tuple[str, str]]
    lists: bool = False


@dataclass(frozen=True)
class Header:
    """What a PLY file says of itself.

    Attributes:
        order: "<" or ">" of a binary file, "" of an ASCII one.
        elements: in the order of their rows.
        comments: without the word "comment".
        length: bytes up to the first row.
    """

    order: str
    elements: tuple[Element, ...]
    comments: tuple[str, ...]
    length: int


def read_header(path: Path) -> Header:
    """Read the header alone.

    Raises:
        PopError: absent, cut off, or it breaks the format's rules; names the line.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(_LONGEST)
    except FileNotFoundError:
        raise PopError(f"{path}: the PLY file is absent; check the path") from None
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check the path and its permissions") from error
    return header_of(head, path)


def header_of(data: bytes, path: Path) -> Header:
    """Read the header at the beginning of a file's bytes.

    Raises:
        PopError: cut off, or it breaks the format's rules; names the line.
    """
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
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check the path and its permissions") from error
    except MemoryError as error:
        raise PopError(f"{path}: does not fit into memory; crop or thin it out first") from error
    return vertices_of(data, path)


def vertices_of(data: bytes, path: Path) -> np.ndarray:
    """Return the rows of the element `vertex` of a file's bytes; see `read_vertices`.

    Raises:
        PopError: as `read_vertices`.
    """
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
    """Return one property of all rows as numbers of the type `kind`.

    Raises:
        PopError: it is a list.
    """
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
