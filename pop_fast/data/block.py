"""A block of a capture that is too large for one training: a list of some of its photographs, and points of its own.

    block.json    the capture's folder, its training frame, and the photographs with their cameras and splits
    points.npz    xyz (float64 [P, 3], the capture's own frame) and rgb (uint8 [P, 3])

No photograph is copied, and the capture's own list is not read again, so that what a block's training needs grows with
the block alone.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.data.pinhole import make_camera
from pop_fast.data.posed_images import Listing, PosedImage, SparsePoints
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import write_atomically

__all__ = ["BLOCK", "find_block", "read_block", "write_block"]

BLOCK: Final = "block"  # what a list of a block says that it is made from
_LIST, _POINTS = "block.json", "points.npz"
_FIX: Final = "remove the folder with all blocks, and start 'pop train --blocks' again with --overwrite"


def find_block(folder: Path) -> bool:
    """Tell whether a folder is a block."""
    return (folder / _LIST).is_file()


def write_block(folder: Path, listing: Listing) -> None:
    """Write a block: its photographs are those of `listing.shots`, its points those of `listing.cloud`.

    Args:
        folder: where to; made where it is absent.
        listing: in the capture's own frame, with the training frame of the whole capture as its `transform`.
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
    write_atomically(folder / _LIST, lambda file: file.write(text.encode()))


def read_block(folder: Path) -> Listing:
    """Read a block.

    Raises:
        CaptureError: the capture is not where it was, or a file is damaged; names it.
    """
    path, points = folder / _LIST, folder / _POINTS
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        root = Path(content["capture"])
        transform = _matrix(content["transform"])
        shots = [_shot(entry) for entry in content["photographs"]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CaptureError(f"{path}: is not what 'pop train --blocks' writes ({error!r}); {_FIX}") from error
    try:
        with np.load(points, allow_pickle=False) as arrays:
            cloud = SparsePoints(np.asarray(arrays["xyz"], np.float64), np.asarray(arrays["rgb"], np.uint8))
        if cloud.xyz.ndim != 2 or cloud.xyz.shape[1] != 3 or cloud.rgb.shape != cloud.xyz.shape:
            raise ValueError(f"xyz has shape {list(cloud.xyz.shape)}, rgb {list(cloud.rgb.shape)}")
        if not np.isfinite(cloud.xyz).all():
            raise ValueError("xyz has an entry that is not finite")
    except (ValueError, KeyError, OSError, EOFError) as error:
        raise CaptureError(f"{points}: is not what 'pop train --blocks' writes ({error!r}); {_FIX}") from error
    if not root.is_dir():
        raise CaptureError(f"{path}: is a block of {root}, which is not there; put the capture back, or {_FIX}")
    return Listing(root, path, shots, cloud, BLOCK, transform=transform)


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


def _shot(entry: Any) -> PosedImage:
    lens = entry["camera"]
    camera = None
    if lens is not None:
        camera = make_camera(
            lens["id"], lens["model"], lens["width"], lens["height"], [float(p) for p in lens["params"]]
        )
    shot = PosedImage(entry["name"], entry["folder"], entry["file"], camera, _matrix(entry["viewmat"]))
    mask = None if entry["mask"] is None else Path(entry["mask"])
    if entry["split"] not in ("train", "test"):
        raise ValueError(f"split is {entry['split']!r}")
    return replace(shot, angle_x=entry["angle_x"], mask=mask, split=entry["split"], turns=int(entry["turns"]))


def _matrix(rows: Any) -> np.ndarray:
    matrix = np.array(rows, np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"a matrix has shape {list(matrix.shape)}, or entries that are not finite")
    return matrix
