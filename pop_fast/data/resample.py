"""Shrinking photographs as Pillow does by `Image.resize(size, Image.BICUBIC)`, to the bit (A32).

gsplat's example trainer makes its photographs of Mip-NeRF 360 so. The filter is Keys' cubic with a = -0.5, stretched by
the factor where an image shrinks, so that every pixel of the source counts; weights are rounded to 22 fractional bits;
rows are resized first, and what that gives is rounded to bytes before columns are. (Pillow 13 takes columns first at
some sizes, where a few values are then another by one level.)

Sources: Keys 1981, eq. 4; Pillow, src/libImaging/Resample.c.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

_A: Final = -0.5
_SUPPORT: Final = 2.0
_FRACTION_BITS: Final = 22


def shrink_bicubic(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize an image.

    Args:
        image: uint8 [H, W, C]
        size: new width and height, px.

    Returns:
        uint8 [size[1], size[0], C]
    """
    across = _resampled(image, size[0])
    return np.ascontiguousarray(_resampled(across.transpose(1, 0, 2), size[1]).transpose(1, 0, 2))


def _resampled(image: np.ndarray, width: int) -> np.ndarray:
    """Resize the second axis. uint8 [H, W, C] -> uint8 [H, width, C]"""
    if image.shape[1] == width:
        return image
    first, weights = _taps(image.shape[1], width)
    total = np.full((image.shape[0], width, image.shape[2]), 1 << (_FRACTION_BITS - 1), dtype=np.int32)
    for k in range(weights.shape[1]):
        # past its last tap a pixel's weights are 0, whatever they are multiplied with
        total += image[:, np.minimum(first + k, image.shape[1] - 1)] * weights[:, k, None]
    return np.clip(total >> _FRACTION_BITS, 0, 255).astype(np.uint8)


def _taps(before: int, after: int) -> tuple[np.ndarray, np.ndarray]:
    """Return each new pixel's first source pixel that counts, and weights from there on. [after], [after, n]"""
    scale = before / after
    stretch = max(scale, 1.0)
    reach = _SUPPORT * stretch
    centers = (np.arange(after) + 0.5) * scale
    first = np.maximum((centers - reach + 0.5).astype(np.int64), 0)
    end = np.minimum((centers + reach + 0.5).astype(np.int64), before)
    offsets = np.arange(math.ceil(reach) * 2 + 1)
    weights = _keys((offsets + first[:, None] - centers[:, None] + 0.5) / stretch)
    weights[offsets >= (end - first)[:, None]] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    fixed = weights * (1 << _FRACTION_BITS)
    return first, np.trunc(fixed + np.copysign(0.5, fixed)).astype(np.int32)


def _keys(x: np.ndarray) -> np.ndarray:
    x = np.abs(x)
    inner = ((_A + 2.0) * x - (_A + 3.0)) * x * x + 1.0
    outer = (((x - 5.0) * x + 8.0) * x - 4.0) * _A
    return np.where(x < 1.0, inner, np.where(x < _SUPPORT, outer, 0.0))
