"""What a COLMAP model holds, whether its files are binary or text, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pop_fast.data.pinhole import PINHOLES, require_colmap

__all__ = ["ImageRecord", "Model", "model_name", "model_names", "parameter_count"]


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """One image with a pose.

    Attributes:
        where: the record in its file, for messages.
        quat: rotation world -> camera, wxyz, as stored. float64 [4]
        translation: world -> camera. float64 [3]
        camera_id: of its camera.
        name: relative file name, as stored.
    """

    where: str
    quat: np.ndarray
    translation: np.ndarray
    camera_id: int
    name: str


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras, images and points of a model.

    Attributes:
        cameras: as `pop_fast.data.pinhole.make_camera` makes them, by id.
        images: in the order of the file.
        point_ids: uint64 [P]
        xyz: float64 [P, 3]
        rgb: uint8 [P, 3]
    """

    cameras: dict[int, Any]
    images: list[ImageRecord]
    point_ids: np.ndarray
    xyz: np.ndarray
    rgb: np.ndarray


@cache
def model_names() -> dict[int, str]:
    """List COLMAP's camera models by their number."""
    models = require_colmap().CameraModelId.__members__.items()
    return {int(model): name for name, model in models if int(model) >= 0}


def model_name(number: int) -> str | None:
    """Return the name of a camera model, or None where no model has that number."""
    for name, (own, _) in PINHOLES.items():
        if own == number:
            return name
    return model_names().get(number)


@cache
def parameter_count(name: str) -> int:
    """Tell how many parameters a camera model has."""
    if name in PINHOLES:
        return max(PINHOLES[name][1]) + 1
    models = require_colmap()
    return len(models.Camera.create_from_model_id(1, models.CameraModelId.__members__[name], 1.0, 1, 1).params)
