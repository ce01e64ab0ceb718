"""Read the binary files of a COLMAP model record by record.

pycolmap takes a truncated file for a complete one, asks for terabytes of memory where a count is corrupt, and cannot
hand over a name that is not UTF-8; here every record must end inside its file, and the last one where the file ends.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.colmap_records import ImageRecord, Model, model_name, model_names, parameter_count
from pop_fast.data.pinhole import make_camera
from pop_fast.errors import CaptureError

__all__ = ["count_images_binary", "read_binary"]

_FIX = "copy the model again, or run COLMAP again"
_POINT = struct.Struct("<Q3d3Bd")


class _Cursor:
    """Read a file's bytes in order, and refuse to run over their end."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def read(self, layout: str | struct.Struct) -> tuple[Any, ...]:
        layout = struct.Struct(layout) if isinstance(layout, str) else layout
        start = self.at
        self.skip(layout.size)
        return layout.unpack_from(self.data, start)

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise EOFError

    def text(self) -> bytes:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise EOFError
        start, self.at = self.at, end + 1
        return self.data[start:end]


def count_images_binary(path: Path) -> int:
    """Read how many images `images.bin` says that it holds; -1 where it does not even say that."""
    with open(path, "rb") as file:
        head = file.read(8)
    return struct.unpack("<Q", head)[0] if len(head) == 8 else -1


def read_binary(folder: Path) -> Model:
    """Read `cameras.bin`, `images.bin` and `points3D.bin`.

    The rigs and frames of COLMAP 3.12 and later are only walked, to find an incomplete copy: every image has its own
    pose in `images.bin` too.

    Raises:
        CaptureError: names the file and the record that is truncated, unknown or unreadable.
    """
    cameras = _read(folder / "cameras.bin", _camera)
    images = _read(folder / "images.bin", _image)
    points = _read(folder / "points3D.bin", _point)
    for name, walk in (("rigs.bin", _walk_rig), ("frames.bin", _walk_frame)):
        if (folder / name).is_file():
            _read(folder / name, walk)
    return Model(
        {camera.camera_id: camera for camera in cameras},
        images,
        np.array([point[0] for point in points], dtype=np.uint64),
        np.array([point[1:4] for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point[4:7] for point in points], dtype=np.uint8).reshape(-1, 3),
    )


def _read(path: Path, record: Callable[[_Cursor], Any]) -> list[Any]:
    cursor = _Cursor(path.read_bytes())
    records: list[Any] = []
    try:
        (count,) = cursor.read("<Q")
        while len(records) < count:
            records.append(record(cursor))
    except EOFError:
        raise CaptureError(f"{path}: the file is truncated; {_FIX}") from None
    except ValueError as error:
        raise CaptureError(f"{path}: {error}; {_FIX}") from error
    left = len(cursor.data) - cursor.at
    if left:
        raise CaptureError(f"{path}: the file has {left} bytes too many; {_FIX}")
    return records


def _camera(cursor: _Cursor) -> Any:
    camera_id, model, width, height = cursor.read("<IiQQ")
    name = model_name(model)
    if name is None:
        raise ValueError(f"camera {camera_id} has the unknown camera model {model} (known: 0 to {max(model_names())})")
    params = cursor.read(f"<{parameter_count(name)}d")
    return make_camera(camera_id, name, width, height, list(params))


def _image(cursor: _Cursor) -> ImageRecord:
    image_id, *pose, camera_id = cursor.read("<I7dI")
    stored = cursor.text()
    try:
        name = stored.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(
            f"image {image_id} has the name {str(stored)[1:]}, which is not UTF-8: rename the photograph"
        ) from None
    (observations,) = cursor.read("<Q")
    cursor.skip(24 * observations)
    return ImageRecord(f"image {image_id} ({name})", np.array(pose[:4]), np.array(pose[4:]), camera_id, name)


def _point(cursor: _Cursor) -> tuple[Any, ...]:
    point = cursor.read(_POINT)
    (track,) = cursor.read("<Q")
    cursor.skip(8 * track)
    return point


def _walk_rig(cursor: _Cursor) -> None:
    _, sensors = cursor.read("<II")
    if sensors:
        cursor.skip(8)
    for _ in range(sensors - 1):
        *_, posed = cursor.read("<iIB")
        cursor.skip(56 if posed else 0)


def _walk_frame(cursor: _Cursor) -> None:
    cursor.skip(64)
    (items,) = cursor.read("<I")
    cursor.skip(16 * items)
