"""Read the cameras that Agisoft Metashape exports as XML (File, Export, Export Cameras, Agisoft XML).

A `transform` is camera-to-chunk with OpenCV's axes; the chunk's or component's own `transform` leads on to the world,
x -> s R x + t. The principal point is given from the photograph's middle, and pixel centres lie at +0.5 as here.
Metashape's p1 and p2 are OpenCV's p2 and p1. A fisheye sensor is OpenCV's where it has no tangential terms.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.fields import Numbers, brown_lens, check_size, shortened, viewmat_from_pose
from pop_fast.data.pinhole import make_camera
from pop_fast.data.posed_images import PosedImage
from pop_fast.errors import CaptureError
from pop_fast.io.images import find_image

__all__ = ["find_metashape", "read_metashape"]

_HEAD = 4096
_EXPORT = "export the cameras again (Agisoft XML)"
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
    """Read all cameras that are aligned, sorted by label.

    Args:
        path: the XML file.
        root: the capture.
        images: the folder in it with the photographs; "" for the capture itself.

    Returns:
        The shots, and notes on cameras that were left out.

    Raises:
        CaptureError: names the file, the element and what it should be.
    """
    try:
        document = ET.fromstring(path.read_bytes())
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    except ET.ParseError as error:
        raise CaptureError(f"{path}: is not valid XML ({error}); {_EXPORT}") from error
    shots: list[PosedImage] = []
    unaligned: list[str] = []
    chunks = document.findall("chunk")
    if not any(chunk.find("cameras") is not None for chunk in chunks):
        raise CaptureError(f"{path}: has no chunk with cameras; {_EXPORT}")
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
            lens = _camera(path, label, sensors.get(str(camera.get("sensor_id"))), len(shots) + 1)
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


def _camera(path: Path, label: str, sensor: ET.Element | None, number: int) -> Any:
    if sensor is None:
        raise CaptureError(f"{path}: camera {label}: sensor_id names no sensor of the file; {_EXPORT}")
    where = f"{path}: sensor {sensor.get('id')}"
    calibrations = sensor.findall("calibration")
    if not calibrations:
        raise CaptureError(f"{where} has no calibration; align the cameras, then export them again")
    # what the alignment has found, in place of what it began with
    chosen = next((one for one in calibrations if one.get("class") == "adjusted"), calibrations[-1])
    resolution = chosen.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise CaptureError(f"{where} has no resolution; {_EXPORT}")
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
