"""Turn photographs of any camera model into photographs of a pinhole camera with the same principal point.

For a pixel centre p of the new image, d = K^-1 p is its ray and x = camera.img_from_cam(d) is where the photograph
shows it; the new image is the photograph sampled there (bilinear, as COLMAP and gsplat). The new K keeps the principal
point exactly and both focal lengths' ratio; one zoom factor is applied to them, the smallest one with which every new
pixel lies inside the photograph. It is 1, and the photograph is returned as it is, bit for bit, where there is no
distortion. Pixel centres are at +0.5, as COLMAP's are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

__all__ = ["Undistortion", "intrinsics", "undistortion"]

# a wide lens may be opened up to twice its focal length's field of view, a strong pincushion closed to a quarter
_ZOOMS = (0.5, 4.0)
# what counts as no distortion at all, px, and as inside the photograph, in widths or heights of it
_IDENTITY = 1e-7
_SLACK = 1e-9


@dataclass(frozen=True, eq=False)
class Undistortion:
    """A resampling of photographs of one camera at one size.

    Attributes:
        K: intrinsics of the pinhole camera, px. float64 [3, 3]
        maps: where to sample the photograph, px with centres at integers; None for the identity. 2 x float32 [H, W]
    """

    K: np.ndarray
    maps: tuple[np.ndarray, np.ndarray] | None

    def image(self, image: np.ndarray) -> np.ndarray:
        """Resample a photograph. uint8 [H, W, D] -> uint8 [H, W, D]"""
        if self.maps is None:
            return image
        return cv2.remap(image, *self.maps, interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def mask(self, mask: np.ndarray) -> np.ndarray:
        """Resample a mask: the nearest pixel decides. bool [H, W] -> bool [H, W]"""
        if self.maps is None:
            return mask
        near = cv2.remap(
            mask.astype(np.uint8), *self.maps, interpolation=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE
        )
        return near.astype(bool)


def intrinsics(camera: Any) -> np.ndarray:
    """Read the pinhole part of a camera: focal lengths and principal point, px. float64 [3, 3]"""
    K = np.eye(3)
    K[0, 0], K[1, 1] = camera.focal_length_x, camera.focal_length_y
    K[0, 2], K[1, 2] = camera.principal_point_x, camera.principal_point_y
    return K


def undistortion(camera: Any, width: int, height: int) -> Undistortion:
    """Plan the undistortion of photographs stored at width x height px, whatever size the camera was calibrated at.

    Args:
        camera: a `PinholeCamera`, or a `pycolmap.Camera` of any perspective model.
        width: of the stored photograph, px.
        height: likewise.

    Raises:
        ValueError: a full-sphere camera, or no zoom between 0.5 and 4 keeps the new image inside the photograph. The
            message continues "camera <id> ...".
    """
    if camera.model_name == "EQUIRECTANGULAR":
        raise ValueError(
            "is EQUIRECTANGULAR, a full sphere that no pinhole image can hold; cut it into perspective views"
        )
    resize = np.array([width / camera.width, height / camera.height])
    K = intrinsics(camera)
    K[:2] *= resize[:, None]

    def source(points: np.ndarray, zoom: float) -> np.ndarray:
        rays = np.ones((len(points), 3))
        rays[:, :2] = (points - K[:2, 2]) / (np.array([K[0, 0], K[1, 1]]) * zoom)
        return camera.img_from_cam(rays) * resize

    fan = _fan(width, height, K[:2, 2])
    if np.abs(source(fan.reshape(-1, 2), 1.0) - fan.reshape(-1, 2)).max() < _IDENTITY:
        return Undistortion(K, None)
    zoom = _smallest_zoom(lambda z: _fits(source(fan.reshape(-1, 2), z).reshape(fan.shape), K[:2, 2], width, height))
    if zoom is None:
        raise ValueError(
            f"({camera.model_name}) has distortion {camera.params.tolist()} that folds the {width}x{height} image over "
            "itself; calibrate it again, or undistort the photographs first"
        )
    maps = np.empty((2, height, width), np.float32)
    points = np.empty((width, 2))
    points[:, 0] = np.arange(width) + 0.5
    # row by row, which stays in the processor's cache
    for row in range(height):
        points[:, 1] = row + 0.5
        # opencv's remap puts pixel centres at integers
        maps[:, row] = (source(points, zoom) - 0.5).T
    K[0, 0] *= zoom
    K[1, 1] *= zoom
    return Undistortion(K, (maps[0], maps[1]))


def _fan(width: int, height: int, center: np.ndarray, steps: int = 48, along: int = 24) -> np.ndarray:
    """Points on straight lines from the principal point to the outline, corners included. float64 [along, M, 2]"""
    s = np.linspace(0.0, 1.0, steps + 1)
    o, one = np.zeros_like(s), np.ones_like(s)
    sides = [np.stack(side, axis=1) for side in ((s, o), (s, one), (o, s), (one, s))]
    outline = np.concatenate(sides) * np.array([width, height])
    fractions = np.linspace(0.0, 1.0, along + 1)[1:, None, None]
    return center + fractions * (outline - center)


def _fits(fan: np.ndarray, center: np.ndarray, width: int, height: int) -> bool:
    """Tell whether a fan's image lies inside the photograph and never turns back towards the centre.

    Without the second condition a polynomial that bends back far outside, as they all do somewhere, would look inside.
    """
    outline = fan[-1] / np.array([width, height])
    # a comparison with NaN is false: rays that the model cannot project do not fit
    inside = np.all((outline >= -_SLACK) & (outline <= 1.0 + _SLACK))
    radii = np.linalg.norm(fan - center, axis=-1)
    return bool(inside and np.all(np.diff(radii, axis=0) >= 0.0))


def _smallest_zoom(fits: Callable[[float], bool], steps: int = 40) -> float | None:
    low, high = _ZOOMS
    if fits(low):
        return low
    if not fits(high):
        return None
    for _ in range(steps):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high
