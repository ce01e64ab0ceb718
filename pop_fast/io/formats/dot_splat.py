"""`.splat`, 32 bytes a Gaussian, without a header: the format of antimatter15's viewer. Colours of degree 0 only.

Centre 3 float32, scale 3 float32 (activated), RGBA 4 uint8, quaternion wxyz 4 uint8 as 128 + 128 q. The frame is that
of PLY. Viewers that load while drawing expect the largest and most opaque first.

Source: https://github.com/antimatter15/splat.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.formats.cloud import SH_C0, Cloud, logits_of_bytes, to_bytes

_ROW: Final = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rot", "u1", 4)])


def largest_first(cloud: Cloud) -> np.ndarray:
    """Order Gaussians by volume times opacity, falling. int64 [N]"""
    return np.argsort(-np.exp(cloud.log_scales.astype(np.float64).sum(axis=1)) * cloud.opacities, kind="stable")


def encode(cloud: Cloud) -> bytes:
    """Write `.splat`; the order of the Gaussians is kept."""
    rgba = np.concatenate([0.5 + SH_C0 * cloud.sh0.astype(np.float64), cloud.opacities[:, None]], axis=1)
    rows = np.zeros(len(cloud), _ROW)
    rows["xyz"] = cloud.means
    rows["scale"] = np.exp(cloud.log_scales.astype(np.float64))
    rows["rgba"] = to_bytes(255.0 * rgba)
    rows["rot"] = to_bytes(128.0 + 128.0 * cloud.quats.astype(np.float64))
    return rows.tobytes()


def decode(data: bytes, path: Path) -> Cloud:
    """Read `.splat`.

    Raises:
        PopError: its size is no multiple of 32 bytes, or a row cannot be drawn; names the row.
    """
    if len(data) % _ROW.itemsize:
        raise PopError(f"{path}: has {len(data)} bytes, no multiple of {_ROW.itemsize}; copy or write the file again")
    rows = np.frombuffer(data, _ROW)
    bad = np.flatnonzero(~(rows["scale"] > 0.0).all(axis=1))
    if len(bad):
        raise PopError(f"{path}: scale of Gaussian {bad[0]} is {rows['scale'][bad[0]].tolist()}; it must be over 0")
    cloud = Cloud(
        means=rows["xyz"].copy(),
        log_scales=np.log(rows["scale"].astype(np.float64)).astype(np.float32),
        quats=((rows["rot"] - 128.0) / 128.0).astype(np.float32),
        logits=logits_of_bytes(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, :3] / 255.0 - 0.5) / SH_C0).astype(np.float32),
        rest=np.zeros((len(rows), 0, 3), np.float32),
    )
    return cloud.checked(path)
