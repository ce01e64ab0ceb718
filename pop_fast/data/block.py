"""A block of a capture that is too large for one training: a list of some of its photographs, and points of its own.

    block.json    the capture's folder, its training frame, and the photographs with their cameras and splits
    points.npz    xyz (float64 [P, 3], the capture's own frame) and rgb (uint8 [P, 3])

No photograph is copied, and the capture's own list is not read again, so that what a block's training needs grows with
the block alone.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np

from pop_fast.data.cameras import PINHOLES, Numbers, check_size, make_camera
from pop_fast.data.capture import Listing, PosedImage, SparsePoints
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.io.read_back import read_arrays, read_json

T = TypeVar("T")


BLOCK: Final = "block"  # what a list of a block says that it is made from
_BLOCK_LIST, _POINTS = "block.json", "points.npz"
_FIX: Final = "remove the folder with all blocks, and start 'pop train --blocks' again with --overwrite"


def find_block(folder: Path) -> bool:
    return (folder / _BLOCK_LIST).is_file()


def write_block(folder: Path, listing: Listing) -> None:
    """Write a block: its photographs are those of `listing.shots`, its points those of `listing.cloud`.

    All is in the capture's own frame, with the training frame of the whole capture as `listing.transform`.
    """
    cloud, transform = listing.cloud, listing.transform
    if cloud is None or transform is None:
        raise ValueError("a block has points and the training frame of its capture")
    content = {
        "capture": str(listing.root.absolute()),
        "transform": transform.tolist(),
        "photographs": [_entry(shot) for shot in listing.shots],
    }
    write_atomically(folder / _POINTS, lambda file: np.savez(file, xyz=cloud.xyz, rgb=cloud.rgb))
    # the list comes last: a folder that has it is whole
    text = json.dumps(content, indent=1) + "\n"
    write_atomically(folder / _BLOCK_LIST, lambda file: file.write(text.encode()))


def read_block(folder: Path) -> Listing:
    """Read a block; a CaptureError says that its capture is not where it was, or names a file that is damaged."""
    path, points = folder / _BLOCK_LIST, folder / _POINTS
    content = _refused_as_capture(lambda: read_json(path, _FIX))
    try:
        root = Path(content["capture"])
        transform = _matrix(content["transform"])
        shots = [_block_shot(entry) for entry in content["photographs"]]
    # pycolmap says what it does not know of a camera by errors of many kinds
    except Exception as error:
        raise CaptureError(f"{path}: is not what 'pop train --blocks' writes ({error!r}); {_FIX}") from error
    cloud = _points(points)
    # a name may be longer than the system takes, which Path's own question raises
    if not os.path.isdir(root):
        raise CaptureError(
            f"{path}: is a block of {str(root)[:200]}, which is not there; put the capture back, or {_FIX}"
        )
    return Listing(root, path, shots, cloud, BLOCK, transform=transform)


def _refused_as_capture(read: Callable[[], T]) -> T:
    try:
        return read()
    except PopError as error:
        raise CaptureError(str(error)) from error


def _points(path: Path) -> SparsePoints:
    arrays = _refused_as_capture(lambda: read_arrays(path, {"xyz": ("f", 2), "rgb": ("u", 2)}, _FIX))
    cloud = SparsePoints(arrays["xyz"].astype(np.float64), arrays["rgb"].astype(np.uint8))
    if cloud.xyz.shape[1] != 3 or cloud.rgb.shape != cloud.xyz.shape:
        shapes = f"xyz has shape {list(cloud.xyz.shape)}, rgb {list(cloud.rgb.shape)}"
        raise CaptureError(f"{path}: is not what 'pop train --blocks' writes ({shapes}); {_FIX}")
    if not np.isfinite(cloud.xyz).all():
        raise CaptureError(f"{path}: xyz has an entry that is not finite; {_FIX}")
    return cloud


def _entry(shot: PosedImage) -> dict[str, Any]:
    camera = shot.camera
    lens = None
    if camera is not None:
        size = {"width": int(camera.width), "height": int(camera.height)}
        lens = {
            "id": int(camera.camera_id),
            "model": camera.model_name,
            **size,
            "params": list(map(float, camera.params)),
        }
    return {
        "name": shot.name,
        "folder": shot.folder,
        "file": shot.file,
        "camera": lens,
        "viewmat": shot.viewmat.tolist(),
        "angle_x": shot.angle_x,
        "mask": None if shot.mask is None else str(shot.mask.absolute()),
        "split": shot.split,
        "turns": shot.turns,
    }


def _block_shot(entry: Any) -> PosedImage:
    lens = entry["camera"]
    camera = None
    texts = [entry[name] for name in ("name", "folder", "file")]
    if not all(isinstance(text, str) and "\0" not in text for text in texts):
        raise ValueError(f"name, folder and file are {texts}")
    if type(entry["turns"]) is not int or not 0 <= entry["turns"] <= 3:
        raise ValueError(f"turns is {entry['turns']!r}")
    if lens is not None:
        where = f"camera of {entry['name']}"
        read = Numbers(where, lens)
        width, height = check_size(where, read("width"), read("height"))
        params = [float(p) for p in lens["params"]]
        if not np.isfinite(params).all():
            raise ValueError(f"{where} has parameters that are not finite")
        if lens["model"] in PINHOLES and len(params) != max(PINHOLES[lens["model"]][1]) + 1:
            raise ValueError(f"{where} has {len(params)} parameters, which are not those of {lens['model']}")
        camera = make_camera(lens["id"], lens["model"], width, height, params)
    shot = PosedImage(entry["name"], entry["folder"], entry["file"], camera, _matrix(entry["viewmat"]))
    mask = None if entry["mask"] is None else Path(entry["mask"])
    if entry["split"] not in ("train", "test"):
        raise ValueError(f"split is {entry['split']!r}")
    angle_x = None if entry["angle_x"] is None else Numbers(entry["name"], entry)("angle_x")
    return replace(shot, angle_x=angle_x, mask=mask, split=entry["split"], turns=entry["turns"])


def _matrix(rows: Any) -> np.ndarray:
    matrix = np.array(rows, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"a matrix has shape {list(matrix.shape)}, or entries that are not finite")
    return matrix
