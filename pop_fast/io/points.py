"""Read a plain point cloud from a PLY file: positions and, where there are any, colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyParseError

from pop_fast.errors import PopError

__all__ = ["read_points", "read_vertices"]


def read_vertices(path: Path) -> tuple[PlyData, np.ndarray]:
    """Read a PLY file, ASCII or binary of either byte order, and return it with the rows of its element `vertex`.

    Raises:
        PopError: absent, truncated, corrupt, or without vertices as element.
    """
    try:
        ply = PlyData.read(str(path))
        return ply, np.array(ply["vertex"].data)
    except FileNotFoundError:
        raise PopError(f"{path}: the PLY file is absent; check the path") from None
    except KeyError:
        raise PopError(f"{path}: has no element 'vertex'; it is not a point cloud or a splat") from None
    except (PlyParseError, ValueError, IndexError, EOFError, OverflowError, MemoryError, TypeError) as error:
        raise PopError(f"{path}: the PLY file is truncated or corrupt: {error}; copy or write it again") from error
    except OSError as error:
        raise PopError(f"{path}: could not be read: {error.strerror}; check the path and its permissions") from error


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions float64 [P, 3] and colours uint8 [P, 3] (mid-gray where the file has none).

    Raises:
        PopError: as `read_vertices`; a coordinate is absent, NaN or Inf.
    """
    _, rows = read_vertices(path)
    names = rows.dtype.names or ()
    for name in "xyz":
        if name not in names:
            raise PopError(f"{path}: vertex has no property {name!r}; a point cloud needs x, y and z")
    xyz = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    bad = np.argwhere(~np.isfinite(xyz))
    if len(bad):
        row, axis = (int(i) for i in bad[0])
        raise PopError(f"{path}: vertex[{row}].{'xyz'[axis]} is {xyz[row, axis]}; every coordinate must be finite")
    if not {"red", "green", "blue"} <= set(names):
        return xyz, np.full((len(xyz), 3), 128, np.uint8)
    rgb = np.stack([rows[name] for name in ("red", "green", "blue")], axis=1)
    if rgb.dtype.kind == "f":  # some writers store colours in [0, 1]
        rgb = np.clip(np.rint(rgb * 255.0), 0, 255)
    return xyz, rgb.astype(np.uint8)
