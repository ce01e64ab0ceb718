"""Read the cameras that other programs have written next to the photographs.

transforms.json is nerfstudio's, instant-ngp's and Blender's (`transforms_train.json` and its siblings). Poses are
camera-to-world in OpenGL's axes (+x right, +y up, -z forward); their y and z columns are negated for OpenCV's.
`applied_transform` is already part of the poses and of the points that nerfstudio writes next to them, so both are used
as they stand.

Polycam's raw export: `keyframes/corrected_cameras/<time>.json`, else `keyframes/cameras`. The corrected cameras are
those that Polycam has improved after the walk, of photographs without distortion. A pose is camera-to-world in ARKit's
axes, which are OpenGL's, its rows `t_00 ... t_23`.

Agisoft Metashape's XML (File, Export, Export Cameras, Agisoft XML): a `transform` is camera-to-chunk with OpenCV's
axes; the chunk's or component's own `transform` leads on to the world, x -> s R x + t. The principal point is given
from the photograph's middle, and pixel centres lie at +0.5 as here. Metashape's p1 and p2 are OpenCV's p2 and p1. A
fisheye sensor is OpenCV's where it has no tangential terms.

RealityCapture's CSV (Registration, Export, Internal/External camera parameters): a row has
`#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`. Angles are degrees: the camera at 0, 0, 0 looks down with
its upper edge to the north (+y), and is turned by Rz(-heading) Rx(pitch) Ry(roll). f, px and py are as if the longer
side were 36 mm, px and py from the photograph's middle. k and t are Brown's terms, t1 and t2 OpenCV's p1 and p2, as
nerfstudio takes them: the program does not publish its convention.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np

from pop_fast.data.camera_models import fields_of, models_of
from pop_fast.data.cameras import (
    WIDEST,
    Numbers,
    affine,
    check_size,
    choose_model,
    make_camera,
    shortened,
    viewmat_from_pose,
)
from pop_fast.data.capture import Listing, PosedImage, SparsePoints, Split
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.image_header import read_size
from pop_fast.io.images import find_image, image_finder, read_image
from pop_fast.io.ply import read_points

# cameras and the photographs that belong to them, the better ones first
_FOLDERS: Final = (("corrected_cameras", "corrected_images"), ("cameras", "images"))


def find_polycam(root: Path) -> Path | None:
    for keyframes in (root / "keyframes", root):
        for cameras, images in _FOLDERS:
            folder = keyframes / cameras
            if (keyframes / images).is_dir() and folder.is_dir() and any(folder.glob("[!.]*.json")):
                return folder
    return None


def photographs_of_polycam(root: Path) -> Path | None:
    """Find the photographs of an export, which lie among depth maps and other versions of themselves; None if none."""
    cameras = find_polycam(root)
    return None if cameras is None else cameras.parent / dict(_FOLDERS)[cameras.name]


def read_polycam(folder: Path, root: Path, images: str) -> tuple[list[PosedImage], list[str]]:
    """Read every camera of an export, sorted by name; its photographs are in its own folder, not in `images`."""
    del images
    photos = folder.parent / dict(_FOLDERS)[folder.name]
    relative = photos.relative_to(root).as_posix()
    # hidden are what a Mac puts next to every file on a disk of another system
    files = enumerate(sorted(folder.glob("[!.]*.json")), start=1)
    find = image_finder()
    return [_shot(path, photos, relative, number, find) for number, path in files], []


def _shot(path: Path, photos: Path, folder: str, number: int, find: Callable[[Path, str], Path | None]) -> PosedImage:
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
    found = find(photos, path.stem)
    name = path.stem if found is None else found.name
    return PosedImage(name, folder, name, camera, viewmat)


def _json(path: Path, fix: str) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    # besides what JSON and UTF-8 do not allow, whole numbers of thousands of digits, and lists in lists in lists
    except (ValueError, RecursionError) as error:
        raise CaptureError(f"{path}: is not valid JSON ({error}); {fix}") from error


def _load(path: Path) -> dict[str, Any]:
    fix = "export the capture again"
    given = _json(path, fix)
    if not isinstance(given, dict):
        raise CaptureError(f"{path}: is no object of a camera's fields (fx, t_00, ...); {fix}")
    return given


def _name(written: object) -> str:
    """Return the name of a file as a list has it, which on Windows may have been written with backslashes."""
    return Path(str(written).replace("\\", "/")).as_posix()


_HEAD = 4096
_EXPORT_XML = "export the cameras again (Agisoft XML)"


def find_metashape(root: Path) -> Path | None:
    """Find a file of exported cameras, the first by name; None where there is none."""
    return _first(root, "*.xml", lambda file: b"<document" in (head := file.read(_HEAD)) and b"<chunk" in head)


def _first(root: Path, pattern: str, is_one: Callable[[BinaryIO], bool]) -> Path | None:
    """Find the first file by name that begins as one of a kind; what cannot be read is passed over."""
    for path in sorted(root.glob(pattern)):
        try:
            with open(path, "rb") as file:
                if is_one(file):
                    return path
        except OSError:
            continue
    return None


def read_metashape(path: Path, root: Path, images: str) -> tuple[list[PosedImage], list[str]]:
    """Read all cameras that are aligned, sorted by label, and notes on those that were left out."""
    try:
        document = ET.fromstring(path.read_bytes())
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    except ET.ParseError as error:
        raise CaptureError(f"{path}: is not valid XML ({error}); {_EXPORT_XML}") from error
    shots: list[PosedImage] = []
    unaligned: list[str] = []
    find = image_finder()
    chunks = document.findall("chunk")
    if not any(chunk.find("cameras") is not None for chunk in chunks):
        raise CaptureError(f"{path}: has no chunk with cameras; {_EXPORT_XML}")
    for chunk in chunks:
        sensors = {str(sensor.get("id")): sensor for sensor in chunk.iterfind("sensors/sensor")}
        frames = {str(part.get("id")): part for part in chunk.iterfind("components/component")}
        # cameras may stand in groups
        for camera in chunk.iterfind("cameras//camera"):
            label = camera.get("label")
            if not label:
                raise CaptureError(f"{path}: camera {camera.get('id')} has no label; it must name its photograph")
            if camera.get("enabled", "1") in ("0", "false"):
                continue
            if camera.find("transform") is None:
                unaligned.append(label)
                continue
            frame = frames.get(str(camera.get("component_id")), chunk)
            viewmat = _viewmat(f"{path}: camera {label}", camera, _similarity(str(path), frame))
            lens = _metashape_camera(path, label, sensors.get(str(camera.get("sensor_id"))), len(shots) + 1)
            found = find(root / images, label)
            name = label if found is None else found.name
            shots.append(PosedImage(name, images, name, lens, viewmat))
    names = [shot.name for shot in shots]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise CaptureError(f"{path}: two cameras have the label {twice}; export one chunk, with labels that differ")
    notes = [
        f"{len(unaligned)} cameras of {path.name} are not aligned and left out, first {label}"
        for label in unaligned[:1]
    ]
    return sorted(shots, key=lambda shot: shot.name), notes


def _numbers(where: str, element: ET.Element | None, count: int) -> np.ndarray:
    words = (element.text or "").split() if element is not None else []
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.all(np.isfinite(values)):
        text = None if element is None else element.text
        raise CaptureError(f"{where} is {shortened(text)}; it must be {count} finite numbers")
    return values


def _similarity(where: str, frame: ET.Element) -> tuple[np.ndarray, np.ndarray, float]:
    """Read R, t and s of x -> s R x + t, from a chunk's frame to the world."""
    found = frame.find("transform")
    if found is None:
        return np.eye(3), np.zeros(3), 1.0
    where = f"{where}: {frame.tag} {frame.get('id')}: transform"
    rotation, translation, scale = (found.find(name) for name in ("rotation", "translation", "scale"))
    R = np.eye(3) if rotation is None else _numbers(f"{where}/rotation", rotation, 9).reshape(3, 3)
    t = np.zeros(3) if translation is None else _numbers(f"{where}/translation", translation, 3)
    s = 1.0 if scale is None else float(_numbers(f"{where}/scale", scale, 1)[0])
    if s <= 0.0:
        raise CaptureError(f"{where}/scale is {s}; it must be > 0")
    return R, t, s


def _viewmat(where: str, camera: ET.Element, frame: tuple[np.ndarray, np.ndarray, float]) -> np.ndarray:
    R, t, s = frame
    pose = _numbers(f"{where}: transform", camera.find("transform"), 16).reshape(4, 4)
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise CaptureError(f"{where}: transform has the last row {pose[3].tolist()}; it must be 0 0 0 1")
    # rows that are not rigid stay so, for the check of the pose to find
    moved = affine(R @ pose[:3, :3], s * (R @ pose[:3, 3]) + t)
    return viewmat_from_pose(f"{where}: transform", moved, opengl=False)


def _metashape_camera(path: Path, label: str, sensor: ET.Element | None, number: int) -> Any:
    if sensor is None:
        raise CaptureError(f"{path}: camera {label}: sensor_id names no sensor of the file; {_EXPORT_XML}")
    where = f"{path}: sensor {sensor.get('id')}"
    calibrations = sensor.findall("calibration")
    if not calibrations:
        raise CaptureError(f"{where} has no calibration; align the cameras, then export them again")
    # what the alignment has found, in place of what it began with
    chosen = next((one for one in calibrations if one.get("class") == "adjusted"), calibrations[-1])
    resolution = chosen.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise CaptureError(f"{where} has no resolution; {_EXPORT_XML}")
    size = Numbers(f"{where}: resolution", resolution.attrib, texts=True)
    width, height = check_size(f"{where}: resolution", size("width"), size("height"))
    read = Numbers(f"{where}: calibration", {child.tag: child.text for child in chosen}, texts=True)
    if read("b2", 0.0) != 0.0:
        raise CaptureError(f"{where}: calibration: b2 is {read('b2'):g}, a skew; optimise the cameras again without b2")
    focal = read("f")
    if focal <= 0.0 or focal + read("b1", 0.0) <= 0.0:
        raise CaptureError(f"{where}: calibration: f is {focal:g}; it must be > 0")
    pinhole = [focal + read("b1", 0.0), focal, 0.5 * width + read("cx", 0.0), 0.5 * height + read("cy", 0.0)]
    kind = chosen.get("type", sensor.get("type", "frame")).removeprefix("equidistant_")
    if kind not in (known := models_of("metashape")):
        fix = f"undistort the photographs there, or calibrate a type of {', '.join(known)}"
        raise CaptureError(f"{where}: calibration has the type {kind!r}, which is not supported; {fix}")
    model, terms = choose_model("metashape", kind, read, f"the type {kind!r}")
    return make_camera(number, model, width, height, pinhole + terms)


_POSE: Final = ("x", "y", "alt", "heading", "pitch", "roll")
_NEEDED: Final = ("#name", *_POSE, "f")
_EXPORT_CSV: Final = 'export "Internal/External camera parameters" as CSV again'
# mm, the longer side that focal lengths refer to
_FILM: Final = 36.0


def find_realitycapture(root: Path) -> Path | None:
    """Find a file of exported cameras, the first by name; None where there is none."""

    def is_one(file: BinaryIO) -> bool:
        head = file.readline(_HEAD).decode("utf-8-sig", "replace")
        return head.startswith("#name") and "heading" in head

    return _first(root, "*.csv", is_one)


def read_realitycapture(path: Path, root: Path, images: str) -> tuple[list[PosedImage], list[str]]:
    """Read all cameras, sorted by name; the photographs say their size, which the file does not."""
    rows = _rows(path)
    sizes = {name: _size(root / images, name) for name, _ in rows}
    known = [size for size in sizes.values() if size is not None]
    if not known:
        raise CaptureError(
            f"{path}: none of its {len(rows)} photographs lies in {root / images}, first {rows[0][0]}; put them there"
        )
    shots: list[PosedImage] = []
    for number, (name, row) in enumerate(rows, start=1):
        where = f"{path}: {name}"
        # that of a photograph which is absent is never used, but it may be skipped
        width, height = sizes[name] or known[0]
        read = Numbers(where, row, texts=True)
        viewmat = viewmat_from_pose(where, _pose(*(read(field) for field in _POSE)), opengl=True)
        shots.append(
            PosedImage(name, images, name, _realitycapture_camera(where, read, width, height, number), viewmat)
        )
    return sorted(shots, key=lambda shot: shot.name), []


def _rows(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: is not UTF-8 ({error}); {_EXPORT_CSV}") from error
    try:
        table = [row for row in csv.DictReader(io.StringIO(text), strict=True) if row.get("#name")]
    except csv.Error as error:
        raise CaptureError(f"{path}: is not valid CSV ({error}); {_EXPORT_CSV}") from error
    if not table:
        raise CaptureError(f"{path}: lists no photograph; {_EXPORT_CSV}")
    absent = [name for name in _NEEDED if name not in table[0]]
    if absent:
        raise CaptureError(f"{path}: has no column {absent[0]}; {_EXPORT_CSV}")
    named = [(_name(row["#name"].strip()), row) for row in table]
    names = [name for name, _ in named]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise CaptureError(f"{path}: lists {twice} twice; remove one of its rows")
    return named


def _size(folder: Path, name: str) -> tuple[int, int] | None:
    found = find_image(folder, name)
    if found is None:
        return None
    size = read_size(found)
    if size is None:
        height, width = read_image(found).shape[:2]
        return width, height
    return size


def _pose(x: float, y: float, alt: float, heading: float, pitch: float, roll: float) -> np.ndarray:
    """Build the camera-to-world matrix, OpenGL's axes. float64 [4, 4]"""
    turns = [(-heading, 0, 1), (pitch, 1, 2), (roll, 2, 0)]
    pose = np.eye(4)
    for degrees, first, second in turns:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turn = np.eye(4)
        turn[[first, first, second, second], [first, second, first, second]] = [c, -s, s, c]
        pose = pose @ turn
    pose[:3, 3] = [x, y, alt]
    return pose


def _realitycapture_camera(where: str, read: Numbers, width: int, height: int, number: int) -> Any:
    focal = read("f")
    if focal <= 0.0:
        raise CaptureError(f"{where}: f is {focal:g}; it must be > 0, in mm for a longer side of {_FILM:g} mm")
    scale = max(width, height) / _FILM
    pinhole = [focal * scale, focal * scale]
    pinhole += [0.5 * width + read("px", 0.0) * scale, 0.5 * height + read("py", 0.0) * scale]
    model, terms = choose_model("realitycapture", "Brown", read, "Brown's model")
    return make_camera(number, model, width, height, pinhole + terms)


_POLYCAM: Final = "keyframes/corrected_cameras or keyframes/cameras"
_CSV: Final = 'CSV file of "Internal/External camera parameters"'
# what it is called, what it is, and how it is found and read
EXPORTS: Final = {
    "polycam": ("Polycam export", _POLYCAM, find_polycam, read_polycam),
    "metashape": ("Metashape cameras", "cameras as Agisoft XML", find_metashape, read_metashape),
    "realitycapture": ("RealityCapture cameras", _CSV, find_realitycapture, read_realitycapture),
}


def read_export(root: Path, program: str = "auto", images: str | None = None) -> Listing | None:
    """Read what a program has exported; "auto" takes the first that is there, and None is returned where none is.

    The photographs are in the folder `images` of the capture; by default that of this name, or the capture itself.
    """
    folder = images or ("images" if (root / "images").is_dir() else "")
    for name, (title, _, find, read) in EXPORTS.items():
        path = find(root) if program in ("auto", name) else None
        if path is not None:
            shots, notes = read(path, root, folder)
            return Listing(root, path, shots, points_beside(root), title, notes)
    return None


# fields that say more than a pinhole holds, and what that means
_IGNORED: Final = {
    "rolling_shutter": "every photograph counts as taken at one moment",
    "fisheye_crop_radius": "mask the photographs where they are dark outside the lens's circle",
}
_NO_PINHOLE: Final = ("latlong", "equirectangular", "orthographic", "ftheta_p0")  # instant-ngp's other lenses
_POINTS = ("sparse_pc.ply", "points3D.ply", "points3d.ply")
# what is measured in pixels of the size w x h; without it, only a field of view can be used
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")
# nerfstudio's list of terms in the place of fields
_TERMS: Final = "distortion_params"


def find_transforms(folder: Path) -> list[Path]:
    """Find `transforms.json`, or Blender's train and test files (validation in place of an absent test file)."""
    if (folder / "transforms.json").is_file():
        return [folder / "transforms.json"]
    train, val, test = (folder / f"transforms_{split}.json" for split in ("train", "val", "test"))
    held_out = test if test.is_file() else val
    return [path for path in (train, held_out) if path.is_file()]


def read_transforms(paths: list[Path]) -> tuple[list[PosedImage], SparsePoints | None, list[str]]:
    """Read cameras and poses of what `find_transforms` found, and the points next to them.

    Returns:
        One shot for every listed frame, sorted by name; the points of `ply_file_path`, of `sparse_pc.ply` or of
        `points3D.ply`, None where there is none; and notes.
    """
    shots: list[PosedImage] = []
    notes: list[str] = []
    named: Path | None = None
    for path in paths:
        listing = _load_transforms(path)
        # a list for training alone says nothing of what to hold out
        split = cast("Split | None", path.stem.partition("_")[2] or None) if len(paths) > 1 else None
        shots += _read_listing(path, listing, split)
        for name, means in _IGNORED.items():
            if any(fields.get(name) not in (None, [0] * 4) for fields in (listing, *listing["frames"])):
                notes.append(f"{name} of {path.name} is ignored: {means}")
        points = listing.get("ply_file_path")
        if points is not None and not isinstance(points, str):
            raise CaptureError(
                f"{path}: ply_file_path is {shortened(points)}; it must be the relative name of a PLY file"
            )
        named = path.parent / _name(points) if points else named
        if points and named is not None and not os.path.isfile(named):
            raise CaptureError(f"{path}: ply_file_path names {named}, which is absent; restore it or remove the field")
    names = sorted(shot.name for shot in shots)
    twice = [a for a, b in itertools.pairwise(names) if a == b]
    if twice:
        lists = " and ".join(map(str, paths))
        raise CaptureError(f"{lists}: frames lists {twice[0]} twice; remove one of them")
    return sorted(shots, key=lambda shot: shot.name), points_beside(paths[0].parent, named), notes


def points_beside(folder: Path, named: Path | None = None) -> SparsePoints | None:
    """Read the points of a capture: those of the file that its list names, else of a file of a usual name, if any."""
    found = [named] if named else [f for f in (folder / name for name in _POINTS) if f.is_file()]
    try:
        return SparsePoints(*read_points(found[0])) if found else None
    except PopError as error:
        raise CaptureError(str(error)) from error


def _load_transforms(path: Path) -> dict[str, Any]:
    listing = _json(path, "write it again or repair it there")
    if not isinstance(listing, dict) or not isinstance(listing.get("frames"), list):
        raise CaptureError(f"{path}: has no list 'frames'; it must be an object as nerfstudio or instant-ngp writes it")
    return listing


def _read_listing(path: Path, listing: dict[str, Any], split: Split | None) -> list[PosedImage]:
    splits = _named_splits(path, listing)
    named = [split for split in ("train", "val", "test") if listing.get(f"{split}_filenames")]
    rest: Split = "test" if "train" in named else "train"
    shots: list[PosedImage] = []
    for index, frame in enumerate(listing["frames"]):
        where = f"{path}: frames[{index}]"
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise CaptureError(f"{where}: file_path is absent; every frame must name its photograph")
        name = _name(frame["file_path"])
        own = split
        if splits:
            if name not in splits and "train" in named and len(named) > 1:  # named by no list
                continue
            own = splits.get(name, rest)
        mask = path.parent / _name(frame["mask_path"]) if frame.get("mask_path") else None
        fields = _fields(listing, frame)
        angle = _angle(where, fields)
        camera = None if angle is not None else _camera(where, fields, index + 1)
        shots.append(PosedImage(name, *_placed(name), camera, _transform_viewmat(where, frame), angle, mask, own))
    return shots


def _placed(name: str) -> tuple[str, str]:
    """Split the name of a photograph into the folder that may be replaced by another one, and the name in there.

    That is the first folder below the list, or below folders above it; of an absolute name all but the file's own.
    """
    if name.startswith("/") or name[1:3] == ":/":
        folder, _, file = name.rpartition("/")
        return folder or "/", file
    parts = name.split("/")
    first = min(1 + next((i for i, part in enumerate(parts) if part != ".."), 0), len(parts) - 1)
    return "/".join(parts[:first]), "/".join(parts[first:])


def _fields(listing: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Merge a frame's own fields over the file's; its own field of view replaces the file's focal lengths too."""
    over = {"camera_angle_x": ("fl_x", "fl_y", "camera_angle_y"), "camera_angle_y": ("fl_y",)}
    replaced = {name for angle, names in over.items() if angle in frame for name in names}
    return {**{name: value for name, value in listing.items() if name not in replaced}, **frame}


def _named_splits(path: Path, listing: dict[str, Any]) -> dict[str, Split]:
    """Read nerfstudio's `train_filenames`, `val_filenames`, `test_filenames`.

    With the first alone, the rest is test; without the first, the rest is train.

    A photograph in several lists belongs to the last of train, val, test: what is tested is never trained on.
    """
    splits: dict[str, Split] = {}
    listed = {_name(f.get("file_path")) for f in listing["frames"] if isinstance(f, dict)}
    in_turn: tuple[Split, ...] = ("train", "val", "test")
    for split in in_turn:
        names = listing.get(f"{split}_filenames")
        if names is not None and not isinstance(names, list):
            raise CaptureError(
                f"{path}: {split}_filenames is {shortened(names)}; it must be a list of file_path entries"
            )
        for name in names or []:
            name = _name(name)
            if name not in listed:
                raise CaptureError(f"{path}: {split}_filenames names {name}, which no frame has as its file_path")
            splits[name] = split
    return splits


def _transform_viewmat(where: str, frame: dict[str, Any]) -> np.ndarray:
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
    number = Numbers(where, {**fields, **_listed_terms(where, fields.get(_TERMS))})
    if other := next((name for name in _NO_PINHOLE if fields.get(name)), None):
        raise CaptureError(f"{where}: {other} is no lens that is supported; cut the photographs into perspective views")
    width, height = int(number("w")), int(number("h"))
    if not (1 <= width <= WIDEST and 1 <= height <= WIDEST):
        raise CaptureError(f"{where}: w x h is {width} x {height}; both must be at least 1 and at most {WIDEST}")
    kind = "OPENCV_FISHEYE" if fields.get("is_fisheye") else str(fields.get("camera_model", "OPENCV"))
    if kind not in (known := models_of("transforms")):
        usable = ", ".join(kind for kind, (first, *_) in known.items() if first.refusal is None)
        raise CaptureError(f"{where}: camera_model is {kind!r}; use one of {usable}, or a COLMAP model")
    model, terms = choose_model("transforms", kind, number, f"camera_model {kind}")
    if model == "FULL_OPENCV" != kind and number("k4", 0.0) and not (number("k5", 0.0) or number("k6", 0.0)):
        raise CaptureError(
            f"{where}: k4 is {number('k4'):g}, which camera_model {kind} has not: name the model BROWN4 if it is the "
            "factor of r^8, as of Metashape, RealityCapture and nerfstudio, or FULL_OPENCV if it is that of OpenCV"
        )
    focal_x = _focal(number, "fl_x", "camera_angle_x", width)
    if focal_x is None:
        raise CaptureError(f"{where}: has neither fl_x nor camera_angle_x; one of them must give the focal length")
    focal_y = _focal(number, "fl_y", "camera_angle_y", height) or focal_x
    if not (focal_x > 0.0 and focal_y > 0.0):
        raise CaptureError(f"{where}: has focal lengths {focal_x}, {focal_y}; both must be > 0")
    pinhole = [focal_x, focal_y, number("cx", width / 2), number("cy", height / 2)]
    return make_camera(camera_id, model, width, height, pinhole + terms)


def _listed_terms(where: str, terms: Any) -> dict[str, Any]:
    """Give the entries of nerfstudio's list of terms names of their own."""
    most = sum(name.startswith(_TERMS) for name in fields_of("transforms"))
    if terms is not None and not (isinstance(terms, list) and len(terms) <= most):
        raise CaptureError(f"{where}: {_TERMS} is {shortened(terms)}; it must be a list of up to {most} numbers")
    return {f"{_TERMS}[{i}]": value for i, value in enumerate(terms or [])}


def _angle(where: str, fields: dict[str, Any]) -> float | None:
    """Read Blender's only intrinsic, the horizontal field of view in radians; None where a file says more."""
    number = Numbers(where, fields)
    if "w" in fields or "h" in fields:
        return None
    measured = any(name in fields for name in _IN_PIXELS) or any(fields.get(k) for k in fields_of("transforms"))
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
