"""Find the COLMAP model of a capture, read it, and judge whether its cameras, poses and points can be used.

Its files, binary or text, are read here. Binary: pycolmap takes a truncated file for a complete one, asks for terabytes
of memory where a count is corrupt, and cannot return a name that is not UTF-8; here every record must end inside its
file, and the last one where the file ends. Text: pycolmap cuts a name at its first space, takes an image for the
observations of the one before it where the empty line between them was left out, and names neither file nor line of
what it cannot read. Its rigs and frames are not needed: every image has its own pose in `images.txt` too.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.camera_models import CAMERA_MODELS, known_model
from pop_fast.data.cameras import make_camera, require_colmap, rigid_from_quat
from pop_fast.data.capture import PosedImage, SparsePoints
from pop_fast.errors import CaptureError
from pop_fast.io.ply import FARTHEST, find_bad_coordinate

_FILES = ("cameras", "images", "points3D")
_FIX = "copy the model again, or run COLMAP again"


def find_model(folder: Path) -> Path | None:
    """Find the model of a capture that has the most images; None where there is no model."""
    models = find_models(folder)
    return models[0][0] if models else None


def find_models(folder: Path) -> list[tuple[Path, int]]:
    """Find a capture's COLMAP models with their numbers of images (-1: unreadable), the largest first.

    Looked for in `sparse` and its subfolders; else in nerfstudio's `colmap/sparse`; else in the folder itself.
    """
    for place in (folder / "sparse", folder / "colmap" / "sparse", folder):
        inside = [path for path in place.iterdir() if path.is_dir()] if place != folder and place.is_dir() else []
        # COLMAP numbers its models, and begins with the one that it thinks best
        inside.sort(key=lambda path: (not path.name.isdigit(), len(path.name), path.name))
        # one of its files makes a model, so that another that is absent is named instead of the model being passed over
        kinds = [f"{name}{suffix}" for name in _FILES for suffix in (".bin", ".txt")]
        found = [path for path in (*inside, place) if any((path / kind).is_file() for kind in kinds)]
        models = [(path, _count_images(path)) for path in found]
        if models:
            return sorted(models, key=lambda model: -model[1])
    return []


def _suffix(model: Path) -> str:
    """Choose the kind of which most is there, so that what is missed is named with its own ending."""
    return max((".bin", ".txt"), key=lambda ending: sum((model / f"{name}{ending}").is_file() for name in _FILES))


def _count_images(model: Path) -> int:
    path = model / f"images{_suffix(model)}"
    if not path.is_file():
        return -1
    return count_images_binary(path) if path.suffix == ".bin" else count_images_text(path)


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log off the terminal: what matters of it is raised as one line."""
    log = require_colmap().logging
    before = log.minloglevel
    log.minloglevel = int(log.Level.FATAL)
    try:
        yield
    finally:
        log.minloglevel = before


def read_model(model: Path) -> tuple[list[PosedImage], SparsePoints]:
    """Read cameras, poses and points of a model.

    Args:
        model: the folder with cameras, images and points3D, `.bin` or `.txt`.

    Returns:
        One shot for every image, sorted by name, and the points in order of their ids.

    Raises:
        CaptureError: a file is absent, truncated, corrupt, or holds an unknown camera model, a name twice, a zero
            quaternion, NaN or a singular camera.
    """
    suffix = _suffix(model)
    for name in _FILES:
        if not (model / f"{name}{suffix}").is_file():
            raise CaptureError(f"{model / name}{suffix}: is absent from the COLMAP model; {_FIX}")
    found = read_binary(model) if suffix == ".bin" else read_text(model)
    for camera in found.cameras.values():
        _check_camera(model / f"cameras{suffix}", camera)
    shots: dict[str, PosedImage] = {}
    seen = _seen_points(found)
    for image in found.images:
        shot = _shot(model / f"images{suffix}", image, found.cameras, seen)
        if shot.name in shots:
            raise CaptureError(f"{model}/images{suffix}: {image.where}: its name is listed twice; remove one of them")
        shots[shot.name] = shot
    return [shots[name] for name in sorted(shots)], _cloud(model / f"points3D{suffix}", found)


def _check_camera(path: Path, camera: Any) -> None:
    where = f"{path}: camera {camera.camera_id} ({camera.model_name})"
    usable = np.abs(camera.params) <= FARTHEST
    if not usable.all():
        index = int(np.argmin(usable))
        raise CaptureError(
            f"{where}: params[{index}] is {camera.params[index]}; it must be finite and within {FARTHEST:.0e}; {_FIX}"
        )
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(f"{where}: is {camera.width}x{camera.height} px; both must be at least 1; {_FIX}")
    focal = camera.params[list(camera.focal_length_idxs())]
    if not np.all(focal > 0.0):
        raise CaptureError(f"{where}: has focal length {focal.min()}; it must be > 0; {_FIX}")


def _shot(path: Path, image: ImageRecord, cameras: dict[int, Any], seen: dict[int, np.ndarray] | None) -> PosedImage:
    where = f"{path}: {image.where}"
    if image.camera_id not in cameras:
        raise CaptureError(f"{where}: its CAMERA_ID {image.camera_id} is not in cameras{path.suffix}; {_FIX}")
    try:
        viewmat = rigid_from_quat(image.quat, image.translation)
    except ValueError as error:
        raise CaptureError(f"{where}: {error}; {_FIX}") from error
    name = image.name.replace("\\", "/")
    points = None if seen is None else seen.get(image.image_id, np.zeros(0, np.int32))
    return PosedImage(name, "images", name, cameras[image.camera_id], viewmat, seen=points)


def _seen_points(model: Model) -> dict[int, np.ndarray] | None:
    """Turn tracks round: which points, by their rows in order of their ids, each image sees; None without any track."""
    lengths = np.array([len(track) for track in model.tracks], np.int64)
    if not lengths.sum():
        return None
    rows = np.empty(len(lengths), np.int32)
    rows[np.argsort(model.point_ids, kind="stable")] = np.arange(len(lengths), dtype=np.int32)
    images, points = np.concatenate(model.tracks).astype(np.int64), np.repeat(rows, lengths)
    order = np.lexsort((points, images))
    ids, first = np.unique(images[order], return_index=True)
    return {int(image): np.unique(part) for image, part in zip(ids, np.split(points[order], first[1:]), strict=True)}


def _cloud(path: Path, model: Model) -> SparsePoints:
    order = np.argsort(model.point_ids, kind="stable")
    xyz = model.xyz[order]
    bad = find_bad_coordinate(xyz)
    if bad is not None:
        row, axis = bad
        raise CaptureError(
            f"{path}: point {model.point_ids[order[row]]}: {'XYZ'[axis]} is {xyz[row, axis]}; every coordinate must be "
            f"finite and within {FARTHEST:.0e}; {_FIX}"
        )
    return SparsePoints(xyz, model.rgb[order])


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One image with a pose."""

    where: str  # the record in its file, for messages
    quat: np.ndarray  # rotation world -> camera, wxyz, as stored. float64 [4]
    translation: np.ndarray  # world -> camera. float64 [3]
    camera_id: int
    name: str
    image_id: int  # by which tracks name it


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras, images and points of a model."""

    cameras: dict[int, Any]  # as `pop_fast.data.cameras.make_camera` makes them, by id
    images: list[ImageRecord]  # in the order of the file
    point_ids: np.ndarray  # uint64 [P]
    xyz: np.ndarray  # float64 [P, 3]
    rgb: np.ndarray  # uint8 [P, 3]
    # ids of the images that see each point, which need not all be in `images`; empty where it has no track
    tracks: list[np.ndarray]


@cache
def model_names() -> dict[int, str]:
    models = require_colmap().CameraModelId.__members__.items()
    return {int(model): name for name, model in models if int(model) >= 0}


def model_name(number: int) -> str | None:
    """Return the name of a camera model, or None where no model has that number."""
    listed = (name for name, model in CAMERA_MODELS.usable() if model.number == number)
    return next(listed, None) or model_names().get(number)


@cache
def parameter_count(name: str) -> int:
    if (known := known_model(name)) is not None:
        return len(known.params)
    models = require_colmap()
    return len(models.Camera.create_from_model_id(1, models.CameraModelId.__members__[name], 1.0, 1, 1).params)


_BINARY_POINT = struct.Struct("<Q3d3Bd")
_NO_TRACK = np.zeros(0, np.uint32)


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

    The rigs and frames of COLMAP 3.12 and later are only walked, to find an incomplete copy.
    """
    cameras = _read(folder / "cameras.bin", _binary_camera)
    images = _read(folder / "images.bin", _binary_image)
    points = _read(folder / "points3D.bin", _binary_point)
    for name, walk in (("rigs.bin", _walk_rig), ("frames.bin", _walk_frame)):
        if (folder / name).is_file():
            _read(folder / name, walk)
    return _model(cameras, images, points)


def _model(cameras: list[Any], images: list[ImageRecord], points: list[tuple[Any, ...]]) -> Model:
    return Model(
        {camera.camera_id: camera for camera in cameras},
        images,
        np.array([point[0] for point in points], dtype=np.uint64),
        np.array([point[1:4] for point in points], dtype=np.float64).reshape(-1, 3),
        np.array([point[4:7] for point in points], dtype=np.uint8).reshape(-1, 3),
        [point[-1] for point in points],
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


def _binary_camera(cursor: _Cursor) -> Any:
    camera_id, model, width, height = cursor.read("<IiQQ")
    name = model_name(model)
    if name is None:
        raise ValueError(f"camera {camera_id} has the unknown camera model {model} (known: 0 to {max(model_names())})")
    params = cursor.read(f"<{parameter_count(name)}d")
    return make_camera(camera_id, name, width, height, list(params))


def _binary_image(cursor: _Cursor) -> ImageRecord:
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
    where = f"image {image_id} ({name})"
    return ImageRecord(where, np.array(pose[:4]), np.array(pose[4:]), camera_id, name, image_id)


def _binary_point(cursor: _Cursor) -> tuple[Any, ...]:
    point = cursor.read(_BINARY_POINT)
    (track,) = cursor.read("<Q")
    start = cursor.at
    cursor.skip(8 * track)
    # pairs of an image and of a place among its observations; copied, so that the file's bytes need not be kept
    return *point, np.frombuffer(cursor.data, "<u4", 2 * track, start)[::2].copy() if track else _NO_TRACK


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


_IMAGE = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID", "NAME")
_CAMERA = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT", "PARAMS[]")
_TEXT_POINT = ("POINT3D_ID", "X", "Y", "Z", "R", "G", "B", "ERROR")


def count_images_text(path: Path) -> int:
    """Count the images of `images.txt`; -1 where it cannot be read."""
    try:
        return sum(1 for _ in _image_lines(path))
    except CaptureError:
        return -1


def read_text(folder: Path) -> Model:
    cameras = [_text_camera(line) for line in _records(folder / "cameras.txt", _CAMERA)]
    images = [_text_image(line) for line in _image_lines(folder / "images.txt")]
    points = [_text_point(line) for line in _records(folder / "points3D.txt", _TEXT_POINT)]
    return _model(cameras, images, points)


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


def _text_camera(line: _Line) -> Any:
    model = line.words[1]
    if model not in CAMERA_MODELS and model not in model_names().values():
        raise CaptureError(f"{line.where}: MODEL is {model!r}; use one of {', '.join(model_names().values())}")
    words = line.words[4].split()
    if len(words) != parameter_count(model):
        raise CaptureError(f"{line.where}: PARAMS[] has {len(words)} numbers; {model} has {parameter_count(model)}")
    params = [line.parse(f"PARAMS[{i}]", word, float) for i, word in enumerate(words)]
    camera_id, width, height = (line.number(field, _whole) for field in ("CAMERA_ID", "WIDTH", "HEIGHT"))
    if camera_id >= _INVALID_ID:
        raise CaptureError(f"{line.where}: CAMERA_ID is {camera_id}; it must be under 2^32 - 1")
    return make_camera(camera_id, model, width, height, params)


def _text_image(line: _Line) -> ImageRecord:
    name = line.words[-1].strip()
    pose = np.array([line.number(field, float) for field in _IMAGE[1:8]])
    image_id = line.number("IMAGE_ID", _whole)
    where = f"image {image_id} ({name})"
    return ImageRecord(where, pose[:4], pose[4:], line.number("CAMERA_ID", _whole), name, image_id)


def _text_point(line: _Line) -> tuple[Any, ...]:
    color = [line.number(field, _whole) for field in "RGB"]
    if max(color) > 255:
        raise CaptureError(f"{line.where}: R, G, B are {color}; each must be a whole number from 0 to 255")
    place = [line.number(field, float) for field in "XYZ"]
    # what follows the error is the track: pairs of an image and of a place among its observations
    track = line.words[-1].split()[1:]
    if len(track) % 2:
        raise CaptureError(f"{line.where}: TRACK[] has {len(track)} numbers; it must be pairs of IMAGE_ID, POINT2D_IDX")
    seen = [line.parse("TRACK[] IMAGE_ID", word, _whole) for word in track[::2]]
    return (line.number("POINT3D_ID", _whole), *place, *color, np.array(seen, np.int64))
