"""Read the cameras that RealityCapture exports as CSV (Registration, Export, Internal/External camera parameters).

A row has `#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2`. Angles are degrees: the camera at 0, 0, 0 looks
down with its upper edge to the north (+y), and is turned by Rz(-heading) Rx(pitch) Ry(roll). f, px and py are as if the
longer side were 36 mm, px and py from the photograph's middle. k and t are Brown's terms, t1 and t2 OpenCV's p1 and p2,
as nerfstudio takes them: the program does not publish its convention.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.data.fields import Numbers, brown_lens, viewmat_from_pose
from pop_fast.data.pinhole import make_camera
from pop_fast.data.posed_images import PosedImage
from pop_fast.errors import CaptureError
from pop_fast.io.image_header import read_size
from pop_fast.io.images import find_image, read_image

__all__ = ["find_realitycapture", "read_realitycapture"]

_POSE: Final = ("x", "y", "alt", "heading", "pitch", "roll")
_NEEDED: Final = ("#name", *_POSE, "f")
_EXPORT: Final = 'export "Internal/External camera parameters" as CSV again'
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
    """Read all cameras, sorted by name.

    Args:
        path: the CSV file.
        root: the capture; its photographs say the size, which the file does not.
        images: the folder in it with the photographs; "" for the capture itself.

    Raises:
        CaptureError: names the file, the row, the field and what it should be.
    """
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
        shots.append(PosedImage(name, images, name, _camera(where, read, width, height, number), viewmat))
    return sorted(shots, key=lambda shot: shot.name)


def _rows(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise CaptureError(f"{path}: could not be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CaptureError(f"{path}: is not UTF-8 ({error}); {_EXPORT}") from error
    try:
        table = [row for row in csv.DictReader(io.StringIO(text), strict=True) if row.get("#name")]
    except csv.Error as error:
        raise CaptureError(f"{path}: is not valid CSV ({error}); {_EXPORT}") from error
    if not table:
        raise CaptureError(f"{path}: lists no photograph; {_EXPORT}")
    absent = [name for name in _NEEDED if name not in table[0]]
    if absent:
        raise CaptureError(f"{path}: has no column {absent[0]}; {_EXPORT}")
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


def _camera(where: str, read: Numbers, width: int, height: int, number: int) -> Any:
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
