"""Read a COLMAP model, binary or text, through pycolmap.

pycolmap takes a truncated binary file for a complete one, or asks for terabytes of memory; so the files are first
walked record by record, and a model is handed over only when every record ends where its file ends.
"""

from __future__ import annotations

import copy
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from pop_fast.data.shots import Cloud, Shot
from pop_fast.errors import CaptureError

__all__ = ["find_model", "quiet_colmap", "read_model"]

_FILES = ("cameras", "images", "points3D")
_FIX = "copy the model again, or run COLMAP again"


def find_model(folder: Path) -> Path | None:
    """Find a capture's COLMAP model: `sparse/0`, `sparse`, nerfstudio's `colmap/sparse/0`, or the folder itself."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0", folder):
        # one of its files makes a model, so that another that is absent is named instead of the model being passed over
        if any((candidate / f"{name}{suffix}").is_file() for name in _FILES for suffix in (".bin", ".txt")):
            return candidate
    return None


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log off the terminal: what matters of it is raised as one line."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def read_model(model: Path) -> tuple[list[Shot], Cloud]:
    """Read cameras, poses and points of a model.

    Args:
        model: the folder with cameras, images and points3D, `.bin` or `.txt` (binary preferred, as COLMAP does).

    Returns:
        One shot for every registered image, sorted by name, and the points in order of their ids.

    Raises:
        CaptureError: a file is absent, truncated, corrupt, or holds an unknown camera model, NaN or a singular camera.
    """
    # the kind of which most is there, so that what is missed is named with its own ending
    suffix = max((".bin", ".txt"), key=lambda ending: sum((model / f"{name}{ending}").is_file() for name in _FILES))
    for name in _FILES:
        if not (model / f"{name}{suffix}").is_file():
            raise CaptureError(f"{model / name}{suffix}: is absent from the COLMAP model; {_FIX}")
    if suffix == ".bin":
        _check_records(model)
    try:
        with quiet_colmap():
            reconstruction = pycolmap.Reconstruction()
            reconstruction.read_binary(model) if suffix == ".bin" else reconstruction.read_text(model)
    except (ValueError, IndexError, RuntimeError, MemoryError, OSError, TypeError) as error:
        raise CaptureError(f"{model}: the COLMAP model is corrupt: {error}; {_FIX}") from error
    # copies, because the reconstruction owns its cameras and ends with this function
    cameras = {key: copy.deepcopy(camera) for key, camera in reconstruction.cameras.items()}
    for camera in cameras.values():
        _check_camera(model / f"cameras{suffix}", camera)
    registered = [image for image in reconstruction.images.values() if image.has_pose]
    shots = [_shot(model / f"images{suffix}", image, cameras[image.camera_id]) for image in registered]
    return sorted(shots, key=lambda shot: shot.name), _cloud(model / f"points3D{suffix}", reconstruction)


def _check_camera(path: Path, camera: Any) -> None:
    where = f"{path}: camera {camera.camera_id} ({camera.model_name})"
    if not np.all(np.isfinite(camera.params)):
        index = int(np.argmin(np.isfinite(camera.params)))
        raise CaptureError(f"{where}: params[{index}] is {camera.params[index]}; {_FIX}")
    if camera.width < 1 or camera.height < 1:
        raise CaptureError(f"{where}: is {camera.width}x{camera.height} px; both must be at least 1; {_FIX}")
    focal = camera.params[list(camera.focal_length_idxs())]
    if not np.all(focal > 0.0):
        raise CaptureError(f"{where}: has focal length {focal.min()}; it must be > 0; {_FIX}")


def _shot(path: Path, image: Any, camera: Any) -> Shot:
    # a method since pycolmap 3.12, a property before
    pose: Any = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    viewmat = np.eye(4)
    viewmat[:3] = pose.matrix()
    if not np.all(np.isfinite(viewmat)):
        raise CaptureError(f"{path}: image {image.name}: its pose has NaN or Inf; {_FIX}")
    name = image.name.replace("\\", "/")
    return Shot(name=name, folder="images", file=name, camera=camera, viewmat=viewmat)


def _cloud(path: Path, reconstruction: Any) -> Cloud:
    ids = sorted(reconstruction.points3D)
    points = [reconstruction.points3D[i] for i in ids]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    bad = ~np.isfinite(xyz).all(axis=1)
    if bad.any():
        raise CaptureError(f"{path}: point {ids[int(np.argmax(bad))]} has NaN or Inf as coordinate; {_FIX}")
    return Cloud(xyz, rgb)


def _check_records(model: Path) -> None:
    """Walk the binary files of a model (those of COLMAP 3.12's rigs and frames too, where present)."""
    walkers: dict[str, Callable[[bytes, int], int]] = {
        "cameras": _skip_camera,
        "images": _skip_image,
        "points3D": _skip_point,
        "rigs": _skip_rig,
        "frames": _skip_frame,
    }
    for name, skip in walkers.items():
        path = model / f"{name}.bin"
        if not path.is_file():
            continue
        data = path.read_bytes()
        try:
            (count,) = struct.unpack_from("<Q", data, 0)
            at = 8
            for _ in range(count):
                at = skip(data, at)
        except (struct.error, IndexError, ValueError) as error:
            raise CaptureError(f"{path}: {_reason(error)}; {_FIX}") from error
        if at != len(data):
            problem = "is truncated" if at > len(data) else f"has {len(data) - at} bytes too many"
            raise CaptureError(f"{path}: the file {problem}; {_FIX}")


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, ValueError) else "the file is truncated"


def _skip_camera(data: bytes, at: int) -> int:
    camera_id, model_id = struct.unpack_from("<Ii", data, at)
    known = {int(model): model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0}
    if model_id not in known:
        raise ValueError(f"camera {camera_id} has the unknown camera model {model_id} (known: 0 to {max(known)})")
    probe = pycolmap.Camera.create_from_model_id(1, known[model_id], 1.0, 1, 1)
    return at + 24 + 8 * len(probe.params)


def _skip_image(data: bytes, at: int) -> int:
    end = data.find(b"\0", at + 64) + 1
    if end == 0:
        raise IndexError
    (points,) = struct.unpack_from("<Q", data, end)
    return end + 8 + 24 * points


def _skip_point(data: bytes, at: int) -> int:
    (track,) = struct.unpack_from("<Q", data, at + 43)
    return at + 51 + 8 * track


def _skip_rig(data: bytes, at: int) -> int:
    (sensors,) = struct.unpack_from("<I", data, at + 4)
    at += 8 + (8 if sensors else 0)
    for _ in range(sensors - 1):
        at += 9 + (56 if data[at + 8] else 0)
    return at


def _skip_frame(data: bytes, at: int) -> int:
    (items,) = struct.unpack_from("<I", data, at + 64)
    return at + 68 + 16 * items
