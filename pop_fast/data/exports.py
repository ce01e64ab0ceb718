"""Read the cameras that other programs have exported beside the photographs: Polycam, Metashape, RealityCapture.

Polycam's raw export: `keyframes/corrected_cameras/<time>.json`, else `keyframes/cameras`. The corrected cameras are
those that Polycam has improved after the walk, of photographs without distortion. A pose is camera-to-world in ARKit's
axes (+x right, +y up, -z forward), its rows `t_00 ... t_23`.

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
import json
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import numpy as np

from pop_fast.data.cameras import Numbers, brown_lens, check_size, make_camera, shortened, viewmat_from_pose
from pop_fast.data.capture import PosedImage, SparsePoints
from pop_fast.data.transforms import points_beside
from pop_fast.errors import CaptureError
from pop_fast.io.image_header import read_size
from pop_fast.io.images import find_image, read_image

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
    """Read every camera of an export, sorted by name, from the folder that `find_polycam` returns."""
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


_HEAD = 4096
_EXPORT_XML = "export the cameras again (Agisoft XML)"
_RADIAL = ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class _Similarity:
    """x -> scale R x + t, from a chunk's frame to the world."""

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def pose(self, pose: np.ndarray) -> np.ndarray:
        moved = np.eye(4)
        # rows that are not rigid stay so, for the check of the pose to find
        moved[:3, :3] = self.rotation @ pose[:3, :3]
        moved[:3, 3] = self.scale * (self.rotation @ pose[:3, 3]) + self.translation
        return moved


def find_metashape(root: Path) -> Path | None:
    """Find a file of exported cameras, the first by name; None where there is none."""
    for path in sorted(root.glob("*.xml")):
        try:
            with open(path, "rb") as file:
                head = file.read(_HEAD)
        except OSError:
            continue
        if b"<document" in head and b"<chunk" in head:
            return path
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
            found = find_image(root / images, label)
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


def _similarity(where: str, frame: ET.Element) -> _Similarity:
    found = frame.find("transform")
    if found is None:
        return _Similarity(np.eye(3), np.zeros(3), 1.0)
    where = f"{where}: {frame.tag} {frame.get('id')}: transform"
    rotation, translation, scale = (found.find(name) for name in ("rotation", "translation", "scale"))
    R = np.eye(3) if rotation is None else _numbers(f"{where}/rotation", rotation, 9).reshape(3, 3)
    t = np.zeros(3) if translation is None else _numbers(f"{where}/translation", translation, 3)
    s = 1.0 if scale is None else float(_numbers(f"{where}/scale", scale, 1)[0])
    if s <= 0.0:
        raise CaptureError(f"{where}/scale is {s}; it must be > 0")
    return _Similarity(R, t, s)


def _viewmat(where: str, camera: ET.Element, frame: _Similarity) -> np.ndarray:
    pose = _numbers(f"{where}: transform", camera.find("transform"), 16).reshape(4, 4)
    if np.abs(pose[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise CaptureError(f"{where}: transform has the last row {pose[3].tolist()}; it must be 0 0 0 1")
    return viewmat_from_pose(f"{where}: transform", frame.pose(pose), opengl=False)


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
    radial, tangential = [read(k, 0.0) for k in _RADIAL], (read("p2", 0.0), read("p1", 0.0))
    kind = chosen.get("type", sensor.get("type", "frame"))
    if kind in ("fisheye", "equidistant_fisheye") and not any(tangential):
        return make_camera(number, "OPENCV_FISHEYE", width, height, pinhole + radial)
    if kind != "frame" or radial[3] != 0.0:
        what = f"the type {kind!r}" if kind != "frame" else f"k4 = {radial[3]:g}"
        fix = "undistort the photographs there, or calibrate type 'frame' with k1 to k3, p1, p2"
        raise CaptureError(f"{where}: calibration has {what}, which is not supported; {fix}")
    model, lens = brown_lens(radial[:3], tangential)
    return make_camera(number, model, width, height, pinhole + lens)


_POSE: Final = ("x", "y", "alt", "heading", "pitch", "roll")
_NEEDED: Final = ("#name", *_POSE, "f")
_EXPORT_CSV: Final = 'export "Internal/External camera parameters" as CSV again'
# mm, the longer side that focal lengths refer to
_FILM: Final = 36.0


def find_realitycapture(root: Path) -> Path | None:
    """Find a file of exported cameras, the first by name; None where there is none."""
    for path in sorted(root.glob("*.csv")):
        try:
            with open(path, "rb") as file:
                head = file.readline(4096).decode("utf-8-sig", "replace")
        except OSError:
            continue
        if head.startswith("#name") and "heading" in head:
            return path
    return None


def read_realitycapture(path: Path, root: Path, images: str) -> list[PosedImage]:
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
    return sorted(shots, key=lambda shot: shot.name)


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
    named = [(Path(row["#name"].strip().replace("\\", "/")).as_posix(), row) for row in table]
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
    if read("k4", 0.0) != 0.0:
        raise CaptureError(f"{where}: k4 is {read('k4'):g}, which is not supported; calibrate with k1 to k3")
    scale = max(width, height) / _FILM
    pinhole = [focal * scale, focal * scale]
    pinhole += [0.5 * width + read("px", 0.0) * scale, 0.5 * height + read("py", 0.0) * scale]
    model, lens = brown_lens([read(k, 0.0) for k in ("k1", "k2", "k3")], (read("t1", 0.0), read("t2", 0.0)))
    return make_camera(number, model, width, height, pinhole + lens)


Program: TypeAlias = Literal["polycam", "metashape", "realitycapture"]
EXPORTS: Final = {
    "polycam": ("Polycam export", find_polycam, "keyframes/corrected_cameras or keyframes/cameras"),
    "metashape": ("Metashape cameras", find_metashape, "cameras as Agisoft XML"),
    "realitycapture": (
        "RealityCapture cameras",
        find_realitycapture,
        'CSV file of "Internal/External camera parameters"',
    ),
}


def find_export(root: Path, program: str = "auto") -> tuple[str, Path] | None:
    """Find what a program has exported, the program and its file or folder; "auto" takes the first that is there."""
    for name, (_, find, _) in EXPORTS.items():
        found = find(root) if program in ("auto", name) else None
        if found is not None:
            return name, found
    return None


def read_export(
    program: str, path: Path, root: Path, images: str | None = None
) -> tuple[list[PosedImage], SparsePoints | None, list[str]]:
    """Read an export that `find_export` found.

    Args:
        program: one of `EXPORTS`.
        path: its file or folder.
        root: the capture.
        images: the folder in it with the photographs; by default `images`, or the capture itself where there is none.

    Returns:
        The shots; the points of `sparse_pc.ply` or `points3D.ply` in the capture, or None; notes.
    """
    folder = images or ("images" if (root / "images").is_dir() else "")
    notes: list[str] = []
    if program == "polycam":
        shots = read_polycam(path, root)
    elif program == "metashape":
        shots, notes = read_metashape(path, root, folder)
    else:
        shots = read_realitycapture(path, root, folder)
    return shots, points_beside(root), notes
