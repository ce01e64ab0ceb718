"""What a COLMAP model holds, whether its files are binary or text, before it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pycolmap

__all__ = ["ImageRecord", "Model", "make_camera", "model_names", "parameter_count"]


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
        cameras: `pycolmap.Camera` by id.
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
    models = pycolmap.CameraModelId.__members__.items()
    return {int(model): name for name, model in models if int(model) >= 0}


@cache
def parameter_count(name: str) -> int:
    """Tell how many parameters a camera model has."""
    probe = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.__members__[name], 1.0, 1, 1)
    return len(probe.params)


def make_camera(camera_id: int, model: str, width: int, height: int, params: list[float]) -> Any:
    """Build a `pycolmap.Camera`, whose fields are not judged yet."""
    return pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
