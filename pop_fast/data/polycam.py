"""Read the cameras of a Polycam raw export: `keyframes/corrected_cameras/<time>.json`, else `keyframes/cameras`.

The corrected cameras are those that Polycam has improved after the walk, of photographs without distortion. A pose is
camera-to-world in ARKit's axes (+x right, +y up, -z forward), its rows `t_00 ... t_23`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.data.fields import Numbers, check_size, viewmat_from_pose
from pop_fast.data.pinhole import make_camera
from pop_fast.data.posed_images import PosedImage
from pop_fast.errors import CaptureError
from pop_fast.io.images import find_image

__all__ = ["find_polycam", "photographs_of_polycam", "read_polycam"]

# cameras and the photographs that belong to them, the better ones first
_FOLDERS: Final = (("corrected_cameras", "corrected_images"), ("cameras", "images"))


def find_polycam(root: Path) -> Path | None:
    """Find the folder of camera files of an export, or None."""
    for keyframes in (root / "keyframes", root):
        for cameras, images in _FOLDERS:
            folder = keyframes / cameras
            if (keyframes / images).is_dir() and folder.is_dir() and any(folder.glob("*.json")):
                return folder
    return None


def photographs_of_polycam(root: Path) -> Path | None:
    """Find the photographs of an export, which lie among depth maps and other versions of themselves; None if none."""
    cameras = find_polycam(root)
    return None if cameras is None else cameras.parent / dict(_FOLDERS)[cameras.name]


def read_polycam(folder: Path, root: Path) -> list[PosedImage]:
    """Read every camera of an export, sorted by name.

    Args:
        folder: as `find_polycam` returns it.
        root: the capture.

    Raises:
        CaptureError: names the file, the field and what it should be.
    """
    photos = folder.parent / dict(_FOLDERS)[folder.name]
    relative = photos.relative_to(root).as_posix()
    return [_shot(path, photos, relative, number) for number, path in enumerate(sorted(folder.glob("*.json")), start=1)]


def _shot(path: Path, photos: Path, folder: str, number: int) -> PosedImage:
    given = _load(path)
    read = Numbers(str(path), given)
    width, height = check_size(str(path), read("width"), read("height"))
    focal = read("fx"), read("fy")
    if min(focal) <= 0.0:
        raise CaptureError(f"{path}: fx, fy are {focal[0]}, {focal[1]}; both must be > 0")
    camera = make_camera(number, "PINHOLE", width, height, [*focal, read("cx"), read("cy")])
    pose = np.eye(4)
    pose[:3] = [[read(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    viewmat = viewmat_from_pose(f"{path}: the matrix t_00 to t_23", pose, opengl=True)
    found = find_image(photos, path.stem)
    name = path.stem if found is None else found.name
    return PosedImage(name, folder, name, camera, viewmat)


def _load(path: Path) -> dict[str, Any]:
    fix = "export the capture again"
    try:
        given = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: is not valid JSON ({error}); {fix}") from error
    if not isinstance(given, dict):
        raise CaptureError(f"{path}: is no object of a camera's fields (fx, t_00, ...); {fix}")
    return given
