"""Read transforms.json: nerfstudio, instant-ngp and Blender (`transforms_train.json` and its siblings).

Poses are camera-to-world in OpenGL's convention (+x right, +y up, -z forward); their y and z columns are negated for
OpenCV's. `applied_transform` is already part of the poses and of the points that nerfstudio writes beside them, so both
are used as they stand.
"""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from pop_fast.data.cameras import WIDEST, Numbers, brown_lens, make_camera, shortened, viewmat_from_pose
from pop_fast.data.capture import PosedImage, SparsePoints, Split
from pop_fast.errors import CaptureError
from pop_fast.io.ply import read_points

__all__ = ["find_transforms", "points_beside", "read_transforms"]

_POINTS = ("sparse_pc.ply", "points3D.ply", "points3d.ply")
_RADIAL = ("k1", "k2", "k3", "k4")
# what is measured in pixels of the size w x h; without it, only a field of view can be used
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_MODELS = ("OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "perspective")


def find_transforms(folder: Path) -> list[Path]:
    """Find `transforms.json`, or Blender's train and test files (validation in place of an absent test file)."""
    if (folder / "transforms.json").is_file():
        return [folder / "transforms.json"]
    train, val, test = (folder / f"transforms_{split}.json" for split in ("train", "val", "test"))
    held_out = test if test.is_file() else val
    return [path for path in (train, held_out) if path.is_file()]


def read_transforms(paths: list[Path]) -> tuple[list[PosedImage], SparsePoints | None]:
    """Read cameras and poses of what `find_transforms` found, and the points beside them.

    Returns:
        One shot for every listed frame, sorted by name, and the points of `ply_file_path`, of `sparse_pc.ply` or of
        `points3D.ply`; None where there is none.
    """
    shots: list[PosedImage] = []
    named: Path | None = None
    for path in paths:
        listing = _load(path)
        split = cast("Split | None", path.stem.partition("_")[2] or None)
        shots += _read_listing(path, listing, split)
        points = listing.get("ply_file_path")
        if points is not None and not isinstance(points, str):
            raise CaptureError(
                f"{path}: ply_file_path is {shortened(points)}; it must be the relative name of a PLY file"
            )
        named = path.parent / points if points else named
    names = sorted(shot.name for shot in shots)
    twice = [a for a, b in itertools.pairwise(names) if a == b]
    if twice:
        raise CaptureError(f"{paths[0]}: frames lists {twice[0]} twice; remove one of them")
    return sorted(shots, key=lambda shot: shot.name), points_beside(paths[0].parent, named)


def points_beside(folder: Path, named: Path | None = None) -> SparsePoints | None:
    """Read the points of a capture: those of the file that its list names, else of a file of a usual name, if any."""
    found = [named] if named else [f for f in (folder / name for name in _POINTS) if f.is_file()]
    return SparsePoints(*read_points(found[0])) if found else None


def _load(path: Path) -> dict[str, Any]:
    try:
        listing = json.loads(path.read_text(encoding="utf-8-sig"))
    except RecursionError:
        raise CaptureError(f"{path}: is nested too deeply to be a list of frames; write it again") from None
    # besides what JSON and UTF-8 do not allow, whole numbers of thousands of digits
    except ValueError as error:
        raise CaptureError(f"{path}: is not valid JSON ({error}); write it again or repair it there") from error
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    if not isinstance(listing, dict) or not isinstance(listing.get("frames"), list):
        raise CaptureError(f"{path}: has no list 'frames'; it must be an object as nerfstudio or instant-ngp writes it")
    return listing


def _read_listing(path: Path, listing: dict[str, Any], split: Split | None) -> list[PosedImage]:
    splits = _named_splits(path, listing)
    shots: list[PosedImage] = []
    for index, frame in enumerate(listing["frames"]):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise CaptureError(f"{where}: file_path is absent; every frame must name its photograph")
        name = Path(frame["file_path"].replace("\\", "/")).as_posix()
        own = split
        if splits:
            if name not in splits and set(splits.values()) != {"train"}:  # named by no list
                continue
            own = splits.get(name, "test")
        mask = path.parent / str(frame["mask_path"]) if frame.get("mask_path") else None
        fields = _fields(listing, frame)
        angle = _angle(where, fields)
        camera = None if angle is not None else _camera(where, fields, index + 1)
        folder, file = name.split("/", 1) if "/" in name and not name.startswith("/") else ("", name)
        shots.append(PosedImage(name, folder, file, camera, _viewmat(where, frame), angle, mask, own))
    return shots


def _fields(listing: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Merge a frame's own fields over the file's; its own field of view replaces the file's focal lengths too."""
    over = {"camera_angle_x": ("fl_x", "fl_y", "camera_angle_y"), "camera_angle_y": ("fl_y",)}
    replaced = {name for angle, names in over.items() if angle in frame for name in names}
    return {**{name: value for name, value in listing.items() if name not in replaced}, **frame}


def _named_splits(path: Path, listing: dict[str, Any]) -> dict[str, Split]:
    """Read nerfstudio's `train_filenames`, `val_filenames`, `test_filenames`; with the first alone, the rest is test.

    A photograph in several lists belongs to the last of train, val, test: what is tested is never trained on.
    """
    splits: dict[str, Split] = {}
    listed = {Path(str(f.get("file_path"))).as_posix() for f in listing["frames"] if isinstance(f, dict)}
    in_turn: tuple[Split, ...] = ("train", "val", "test")
    for split in in_turn:
        names = listing.get(f"{split}_filenames")
        if names is not None and not isinstance(names, list):
            raise CaptureError(
                f"{path}: {split}_filenames is {shortened(names)}; it must be a list of file_path entries"
            )
        for name in names or []:
            name = Path(str(name)).as_posix()
            if name not in listed:
                raise CaptureError(f"{path}: {split}_filenames names {name}, which no frame has as its file_path")
            splits[name] = split
    return splits


def _viewmat(where: str, frame: dict[str, Any]) -> np.ndarray:
    field = f"{where}: transform_matrix"
    try:
        pose = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.zeros(0)
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise CaptureError(f"{field} has shape {list(pose.shape)}; it must be 4x4 numbers, camera to world")
    return viewmat_from_pose(field, pose, opengl=True)


def _camera(where: str, fields: dict[str, Any], camera_id: int) -> Any:
    """Build the camera of a frame: its own fields before the file's."""
    number = Numbers(where, fields)
    width, height = int(number("w")), int(number("h"))
    if not (1 <= width <= WIDEST and 1 <= height <= WIDEST):
        raise CaptureError(f"{where}: w x h is {width} x {height}; both must be at least 1 and at most {WIDEST}")
    model = "OPENCV_FISHEYE" if fields.get("is_fisheye") else str(fields.get("camera_model", "OPENCV"))
    if model not in _MODELS:
        raise CaptureError(f"{where}: camera_model is {model!r}; use one of {', '.join(_MODELS)}, or a COLMAP model")
    focal_x = _focal(number, "fl_x", "camera_angle_x", width)
    if focal_x is None:
        raise CaptureError(f"{where}: has neither fl_x nor camera_angle_x; one of them must give the focal length")
    focal_y = _focal(number, "fl_y", "camera_angle_y", height) or focal_x
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise CaptureError(f"{where}: has focal lengths {focal_x}, {focal_y}; both must be > 0")
    pinhole = [focal_x, focal_y, number("cx", width / 2), number("cy", height / 2)]
    name, lens = _lens(where, model, number)
    return make_camera(camera_id, name, width, height, pinhole + lens)


def _angle(where: str, fields: dict[str, Any]) -> float | None:
    """Read Blender's only intrinsic, the horizontal field of view in radians; None where a file says more."""
    number = Numbers(where, fields)
    if "w" in fields or "h" in fields:
        return None
    measured = any(name in fields for name in _IN_PIXELS) or any(fields.get(k) for k in _RADIAL)
    if measured or "camera_angle_x" not in fields:
        raise CaptureError(f"{where}: w and h are absent; they give the size that the intrinsics are measured in")
    angle = number("camera_angle_x")
    if not 0.0 < angle < math.pi:
        raise CaptureError(f"{where}: camera_angle_x is {angle}; it must be between 0 and pi radians")
    return angle


def _focal(number: Numbers, focal: str, angle: str, size: float) -> float | None:
    if focal in number.fields:
        return number(focal)
    if angle in number.fields:
        half = math.tan(number(angle) / 2.0)
        return 0.5 * size / half if half > 0.0 else 0.0
    return None


def _lens(
    where: str, model: str, number: Numbers
) -> tuple[Literal["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"], list[float]]:
    if model.endswith("PINHOLE"):
        return "PINHOLE", []
    k1, k2, k3, k4 = (number(k, 0.0) for k in _RADIAL)
    if model == "OPENCV_FISHEYE":
        return "OPENCV_FISHEYE", [k1, k2, k3, k4]
    if k4:
        raise CaptureError(
            f"{where}: k4 is {k4}; OPENCV's fourth radial term is not supported, calibrate with k1 to k3"
        )
    return brown_lens((k1, k2, k3), (number("p1", 0.0), number("p2", 0.0)))
