"""Pictures of arrays: error maps, depth maps, dominant-id maps, and their way into a page as data URIs."""

from __future__ import annotations

import base64
from typing import Final

import cv2
import numpy as np

COLORMAP: Final = "magma"
_MAX_SIDE: Final = 640


def colormap_table(name: str = COLORMAP) -> np.ndarray:
    """Give the colours of one of matplotlib's maps; magma, which is perceptually uniform, for errors. uint8 [256, 3]"""
    from matplotlib import colormaps

    return np.round(colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0).astype(np.uint8)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Round an image in [0, 1] to 8 bit, clamped."""
    return np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)


def error_magnitude(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Take each pixel's error: the mean over the channels of |image - photo|, in [0, 1]. [H, W] from uint8 [H, W, 3]"""
    return np.abs(image.astype(np.float32) - photo.astype(np.float32)).mean(axis=2) / 255.0


def error_scale(errors: list[np.ndarray]) -> float:
    """Choose one top of the scale for all views: their joint 99th percentile, rounded up to a step of 0.05."""
    if not errors:
        return 0.1
    top = float(np.quantile(np.concatenate([e.ravel()[:: max(1, e.size // 50_000)] for e in errors]), 0.99))
    return min(max(np.ceil(top / 0.05 - 1e-4) * 0.05, 0.05), 1.0)


def error_picture(error: np.ndarray, top: float) -> np.ndarray:
    """Colour an error map: black-violet is 0, pale yellow is `top` and more. uint8 [H, W, 3]"""
    return colormap_table()[np.clip(np.round(error / top * 255.0), 0, 255).astype(np.uint8)]


def id_colors(ids: np.ndarray) -> np.ndarray:
    """Colour Gaussian ids, int [H, W], so that one id always has one colour and neighbours differ; -1 (none) is black.

    The id is hashed (splitmix64), its bits give a hue and one of two levels of saturation and brightness.
    """
    with np.errstate(over="ignore"):
        z = ids.astype(np.int64).astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    hue = ((z & np.uint64(0xFF)) * np.uint64(180) // np.uint64(256)).astype(np.uint8)
    saturation = np.where(z & np.uint64(0x100), 120, 200).astype(np.uint8)
    value = np.where(z & np.uint64(0x200), 235, 170).astype(np.uint8)
    colors = cv2.cvtColor(np.stack([hue, saturation, value], axis=-1), cv2.COLOR_HSV2RGB)
    colors[ids < 0] = 0
    return colors


def fit(picture: np.ndarray, nearest: bool = False, max_side: int = _MAX_SIDE) -> np.ndarray:
    """Shrink a picture so that its longer side is at most `max_side` px; smaller ones stay as they are."""
    scale = max_side / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(picture, size, interpolation=cv2.INTER_NEAREST if nearest else cv2.INTER_AREA)


def data_uri(picture: np.ndarray, lossless: bool = False) -> str:
    """Pack an RGB picture, uint8 [H, W, 3], into a data URI: PNG when lossless, else JPEG at quality 88."""
    kind, options = ("png", [cv2.IMWRITE_PNG_COMPRESSION, 9]) if lossless else ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, 88])
    ok, data = cv2.imencode(f".{kind}", np.ascontiguousarray(picture[:, :, ::-1]), options)
    if not ok:
        raise ValueError(f"picture of shape {list(picture.shape)} cannot be written as {kind}")
    return f"data:image/{kind};base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def colorbar_css(name: str = COLORMAP) -> str:
    """Give the colours of a map as a CSS gradient from the bottom to the top of the scale."""
    stops = colormap_table(name)[np.linspace(0, 255, 12).astype(int)]
    return "linear-gradient(90deg," + ",".join(f"#{r:02x}{g:02x}{b:02x}" for r, g, b in stops) + ")"


DEPTH_COLORS: Final = "viridis_r"
_NOTHING: Final = (112, 112, 118)


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Choose one range for all depth maps: their joint 1st to 99th percentile, without NaN."""
    known = [depth[np.isfinite(depth)][:: max(1, depth.size // 50_000)] for depth in depths]
    joined = np.concatenate(known) if known else np.zeros(0)
    if not len(joined):
        return 0.1, 1.0
    near, far = (max(float(np.quantile(joined, q)), 1e-12) for q in (0.01, 0.99))
    return near, max(far, near * (1.0 + 1e-6))


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Colour a depth map [H, W] by its logarithm, near in yellow and far in violet, grey where it is not finite.

    A garden has its background many times as far away as its table: evenly spaced colours would leave the table one.
    """
    known = np.isfinite(depth)
    level = np.log(np.clip(np.where(known, depth, near), near, far) / near) / np.log(far / near)
    picture = colormap_table(DEPTH_COLORS)[np.round(255.0 * level).astype(np.uint8)]
    picture[~known] = _NOTHING
    return picture
