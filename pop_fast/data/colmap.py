"""Find the COLMAP model of a capture, read it, and judge whether its cameras, poses and points can be used."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.capture import PosedImage, SparsePoints
from pop_fast.data.colmap_files import (
    ImageRecord,
    Model,
    count_images_binary,
    count_images_text,
    read_binary,
    read_text,
)
from pop_fast.data.fields import rigid_from_quat
from pop_fast.data.pinhole import require_colmap
from pop_fast.errors import CaptureError
from pop_fast.io.ply_rows import FARTHEST, find_bad_coordinate

__all__ = ["find_model", "find_models", "quiet_colmap", "read_model"]

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
        models = [(path, _count_images(path)) for path in (*inside, place) if _holds_model(path)]
        if models:
            return sorted(models, key=lambda model: -model[1])
    return []


def _holds_model(folder: Path) -> bool:
    # one of its files makes a model, so that another that is absent is named instead of the model being passed over
    return any((folder / f"{name}{suffix}").is_file() for name in _FILES for suffix in (".bin", ".txt"))


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
        model: the folder with cameras, images and points3D, `.bin` or `.txt` (binary preferred, as COLMAP does).

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
