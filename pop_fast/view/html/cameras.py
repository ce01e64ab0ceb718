"""Where a page starts: the training cameras, and the point that its view turns about."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from torch import Tensor

from pop_fast.data.capture import View

# of a larger capture every so many, evenly
_MOST: Final = 60


@dataclass(frozen=True)
class PageCamera:
    """A pinhole camera.

    Attributes:
        name: what the page shows of it.
        viewmat: world -> camera, y down, z forward. [4, 4]
        K: intrinsics, px. [3, 3]
        width: px
        height: px
    """

    name: str
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int

    @property
    def eye(self) -> np.ndarray:
        """Its place in the world. [3]"""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def entry(self, distance: float) -> dict[str, Any]:
        """Return what the page reads, with the distance from the eye to the point that the view turns about."""
        lens = {"fx": self.K[0, 0], "fy": self.K[1, 1], "cx": self.K[0, 2], "cy": self.K[1, 2]}
        return {
            "name": self.name,
            "rotation": self.viewmat[:3, :3].tolist(),
            "eye": self.eye.tolist(),
            "distance": distance,
            **{key: float(value) for key, value in lens.items()},
            "width": self.width,
            "height": self.height,
        }


def cameras_of(views: Sequence[View]) -> list[PageCamera]:
    """Take over the cameras of views, at most sixty, evenly."""
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MOST)).round().astype(int)) if views else []
    return [
        PageCamera(views[i].name, views[i].viewmat, views[i].K, views[i].image.shape[1], views[i].image.shape[0])
        for i in chosen
    ]


def camera_of_points(means: Tensor) -> PageCamera:
    """Make a camera that sees most of some points, for a splat whose cameras are not known; y is down."""
    points = means.double().numpy() if len(means) else np.zeros((1, 3))
    middle = np.median(points, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.7)), 1e-3)
    viewmat = np.eye(4)
    viewmat[:3, 3] = -middle + [0.0, 0.0, 2.5 * radius]
    return PageCamera("view", viewmat, np.array([[800.0, 0.0, 400.0], [0.0, 800.0, 300.0], [0.0, 0.0, 1.0]]), 800, 600)


def view_distances(cameras: Sequence[PageCamera], means: Tensor) -> list[float]:
    """Return how far ahead of every camera lies the point that its view turns about.

    It is at the depth of the point that is nearest to all optical axes, or where that is behind the camera, of the
    median Gaussian ahead of it.
    """
    axes = np.stack([camera.viewmat[2, :3] for camera in cameras])
    eyes = np.stack([camera.eye for camera in cameras])
    across = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    # parallel axes meet nowhere: then it is the least-norm answer, which the test below mostly refuses
    focus = np.linalg.lstsq(across.sum(0), (across @ eyes[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]
    points = means.double().numpy()
    found = []
    for axis, eye in zip(axes, eyes, strict=True):
        depths = (points - eye) @ axis
        ahead = depths[depths > 0.0]
        typical = float(np.median(ahead)) if len(ahead) else 1.0
        depth = float((focus - eye) @ axis)
        found.append(depth if 0.1 * typical < depth < 10.0 * typical else typical)
    return found
