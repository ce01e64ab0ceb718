"""What the readers of COLMAP models and transforms.json hand over: where each photograph was taken, not yet read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.capture import Split

__all__ = ["Listing", "PosedImage", "SparsePoints"]


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One listed photograph.

    Attributes:
        name: as listed; unique, and what views are sorted by.
        folder: the image folder, relative to the capture; "" for the capture itself.
        file: relative name in that folder; the extension may differ from the file's.
        camera: a `PinholeCamera` or `pycolmap.Camera`, or None where only the field of view is known.
        viewmat: world -> camera, rigid. float64 [4, 4]
        angle_x: horizontal field of view in radians, where `camera` is None.
        mask: the mask file that the list names, if any.
        split: the list's own assignment, if any.
        turns: quarter turns clockwise that make the photograph upright; `camera` and `viewmat` are those of its pixels
            as they are stored.
    """

    name: str
    folder: str
    file: str
    camera: Any
    viewmat: np.ndarray
    angle_x: float | None = None
    mask: Path | None = None
    split: Split | None = None
    turns: int = 0


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Sparse points.

    Attributes:
        xyz: float64 [P, 3]
        rgb: uint8 [P, 3]
    """

    xyz: np.ndarray
    rgb: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class Listing:
    """What a capture lists, its photographs not read.

    Attributes:
        root: the folder that the photographs' folders are in.
        path: the file or model that lists them, for messages.
        shots: where each was taken.
        cloud: sparse points; None where there are none.
        made_from: what kind of list it is.
        notes: one line each.
        transform: the training frame, where that is decided already; None normalizes. float64 [4, 4]
        sfm_seconds: how long the cameras were searched for, where that was done now.
    """

    root: Path
    path: Path
    shots: list[PosedImage]
    cloud: SparsePoints | None
    made_from: str
    notes: list[str] = field(default_factory=list)
    transform: np.ndarray | None = None
    sfm_seconds: float | None = None
