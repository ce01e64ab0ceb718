"""Read a plain point cloud from a PLY file: positions and, where there are any, colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pop_fast.errors import PopError

if TYPE_CHECKING:
    from plyfile import PlyData

__all__ = ["FARTHEST", "find_bad_coordinate", "read_points", "read_vertices"]

# the square of a distance must stay a number in single precision, and a scene of this size is a corrupt file
FARTHEST = 1e15
# a float colour may lie a little over 1 without being one of those up to 255
_BRIGHTEST = 2.0


def read_vertices(path: Path) -> tuple[PlyData, np.ndarray]:
    """Read a PLY file, ASCII or binary of either byte order, and return it with the rows of its element `vertex`.

    Raises:
        PopError: absent, truncated, corrupt, or without vertices as element.
    """
    # not at the top: training reads and writes everything else without it
    from plyfile import PlyParseError

    try:
        ply = _read_ply(path)
        return ply, np.array(ply["vertex"].data)
    except FileNotFoundError:
        raise PopError(f"{path}: the PLY file is absent; check the path") from None
    except KeyError:
        raise PopError(f"{path}: has no element 'vertex'; it is not a point cloud or a splat") from None
    except (PlyParseError, ValueError, IndexError, EOFError, OverflowError, MemoryError, TypeError) as error:
        raise PopError(f"{path}: the PLY file is truncated or corrupt: {error}; copy or write it again") from error
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check the path and its permissions") from error


def _read_ply(path: Path) -> PlyData:
    from plyfile import PlyData

    try:
        return PlyData.read(str(path))
    except UnicodeDecodeError:
        # plyfile reads headers as ASCII, and comments are written in any language
        head, end, rows = path.read_bytes().partition(b"\nend_header")
        head = bytes(byte if byte < 128 else ord("?") for byte in head)
        return PlyData.read(io.BytesIO(head + end + rows))


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
    _, rows = read_vertices(path)
    names = rows.dtype.names or ()
    for name in "xyz":
        if name not in names:
            raise PopError(f"{path}: vertex has no property {name!r}; a point cloud needs x, y and z")
    xyz = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
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
    rgb = np.stack([rows[name].astype(np.float64) for name in names], axis=1)
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
