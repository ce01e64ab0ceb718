"""Read the text files of a COLMAP model line by line.

pycolmap cuts a name at its first space, takes an image for the observations of the one before it where the empty line
between them was left out, and tells neither file nor line of what it cannot read. Its rigs and frames are not needed:
every image has its own pose in `images.txt` too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.colmap_records import ImageRecord, Model, model_names, parameter_count
from pop_fast.data.pinhole import PINHOLES, make_camera
from pop_fast.errors import CaptureError

__all__ = ["count_images_text", "read_text"]

_IMAGE = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID", "NAME")
_CAMERA = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT", "PARAMS[]")
_POINT = ("POINT3D_ID", "X", "Y", "Z", "R", "G", "B", "ERROR")


def count_images_text(path: Path) -> int:
    """Count the images of `images.txt`; -1 where it cannot be read."""
    try:
        return sum(1 for _ in _image_lines(path))
    except CaptureError:
        return -1


def read_text(folder: Path) -> Model:
    """Read `cameras.txt`, `images.txt` and `points3D.txt`.

    Raises:
        CaptureError: names the file, the line and the field that is absent or cannot be read.
    """
    cameras: dict[int, Any] = {}
    for line in _records(folder / "cameras.txt", _CAMERA):
        camera = _camera(line)
        cameras[camera.camera_id] = camera
    images = [_image(line) for line in _image_lines(folder / "images.txt")]
    points = [_point(line) for line in _records(folder / "points3D.txt", _POINT)]
    return Model(
        cameras,
        images,
        np.array([point[0] for point in points], dtype=np.uint64),
        np.array([point[1:4] for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point[4:7] for point in points], dtype=np.uint8).reshape(-1, 3),
    )


class _Line:
    """The fields of one line, read by name."""

    def __init__(self, path: Path, number: int, text: str, fields: tuple[str, ...]) -> None:
        self.where, self.fields = f"{path}: line {number}", fields
        # the last field takes the rest of the line: a name may hold spaces, parameters and tracks are lists
        self.words = text.split(maxsplit=len(fields) - 1)
        if len(self.words) < len(fields):
            raise CaptureError(
                f"{self.where}: {fields[len(self.words)]} is absent; a record here is {', '.join(fields)}"
            )

    def number(self, field: str, kind: Callable[[str], Any]) -> Any:
        return self.parse(field, self.words[self.fields.index(field)], kind)

    def parse(self, field: str, word: str, kind: Callable[[str], Any]) -> Any:
        try:
            return kind(word)
        except ValueError:
            what = "a whole number" if kind is _whole else "a number"
            raise CaptureError(f"{self.where}: {field} is {word!r}; it must be {what}") from None


# COLMAP's ids have 32 bits, and the last one means none
_INVALID_ID = 2**32 - 1


def _whole(word: str) -> int:
    value = int(word)
    if not 0 <= value < 2**63:
        raise ValueError
    return value


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").split("\n")
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: is not UTF-8 ({error}); save it as UTF-8") from error


def _is_record(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _records(path: Path, fields: tuple[str, ...]) -> Iterator[_Line]:
    for number, text in enumerate(_lines(path), start=1):
        if _is_record(text):
            yield _Line(path, number, text, fields)


def _image_lines(path: Path) -> Iterator[_Line]:
    """Yield the first of the two lines of every image, and look whether the second can be one."""
    lines = iter(enumerate(_lines(path), start=1))
    for number, text in lines:
        if not _is_record(text):
            continue
        image = _Line(path, number, text, _IMAGE)
        second, observations = next(lines, (number + 1, ""))
        words = observations.split()
        if words and (len(words) % 3 or not _is_number(words[-1])):
            raise CaptureError(
                f"{path}: line {second}: must hold the POINTS2D[] of image {image.words[-1].strip()}, as X, Y, "
                "POINT3D_ID each; put an empty line there if it has none"
            )
        yield image


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _camera(line: _Line) -> Any:
    model = line.words[1]
    if model not in PINHOLES and model not in model_names().values():
        raise CaptureError(f"{line.where}: MODEL is {model!r}; use one of {', '.join(model_names().values())}")
    words = line.words[4].split()
    if len(words) != parameter_count(model):
        raise CaptureError(f"{line.where}: PARAMS[] has {len(words)} numbers; {model} has {parameter_count(model)}")
    params = [line.parse(f"PARAMS[{i}]", word, float) for i, word in enumerate(words)]
    camera_id, width, height = (line.number(field, _whole) for field in ("CAMERA_ID", "WIDTH", "HEIGHT"))
    if camera_id >= _INVALID_ID:
        raise CaptureError(f"{line.where}: CAMERA_ID is {camera_id}; it must be under 2^32 - 1")
    return make_camera(camera_id, model, width, height, params)


def _image(line: _Line) -> ImageRecord:
    name = line.words[-1].strip()
    pose = np.array([line.number(field, float) for field in _IMAGE[1:8]])
    where = f"image {line.number('IMAGE_ID', _whole)} ({name})"
    return ImageRecord(where, pose[:4], pose[4:], line.number("CAMERA_ID", _whole), name)


def _point(line: _Line) -> tuple[float, ...]:
    color = [line.number(field, _whole) for field in "RGB"]
    if max(color) > 255:
        raise CaptureError(f"{line.where}: R, G, B are {color}; each must be a whole number from 0 to 255")
    place = [line.number(field, float) for field in "XYZ"]
    return (line.number("POINT3D_ID", _whole), *place, *color)
