"""The values that pass between stages, frozen. Gaussians and cameras are validated when made, and print as code.

All arrays are float64 (ids and extents int64). Shapes are in `notation`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any

import numpy as np

from pop_ref._shapes import Bool, Float64, Int64


def _as_float64(name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim != len(shape) or any(
        want is not None and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        want = "[" + ", ".join("N" if s is None else str(s) for s in shape) + "]"
        raise ValueError(f"{name} has shape {list(array.shape)}; it must be {want}")
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        raise ValueError(f"{name}{list(index)} is {array[index]}; every entry must be finite")
    return array


class _PrintsAsCode:
    def __repr__(self) -> str:
        parts: list[str] = []
        for field in fields(self):  # type: ignore[arg-type]
            value = getattr(self, field.name)
            parts.append(f"{field.name}={value.tolist() if isinstance(value, np.ndarray) else value!r}")
        return f"{type(self).__name__}({', '.join(parts)})"


@dataclass(frozen=True, repr=False)
class Gaussians(_PrintsAsCode):
    """Activated Gaussians of a scene.

    Attributes:
        means: centres, world units. [N, 3]
        quats: rotations wxyz, any norm > 0. [N, 4]
        scales: standard deviations, world units, >= 0. [N, 3]
        opacities: in [0, 1]. [N]
        sh: spherical-harmonics coefficients, n_sh in {1, 4, 9, 16}. [N, n_sh, 3]
    """

    means: Float64[np.ndarray, "N 3"]
    quats: Float64[np.ndarray, "N 4"]
    scales: Float64[np.ndarray, "N 3"]
    opacities: Float64[np.ndarray, " N"]
    sh: Float64[np.ndarray, "N n_sh 3"]

    def __post_init__(self) -> None:
        means = _as_float64("means", self.means if np.size(self.means) else np.zeros((0, 3)), (None, 3))
        n = len(means)
        empty = {"quats": (0, 4), "scales": (0, 3), "opacities": (0,), "sh": (0, 1, 3)}
        shapes: dict[str, tuple[int | None, ...]] = {
            "quats": (n, 4),
            "scales": (n, 3),
            "opacities": (n,),
            "sh": (n, None, 3),
        }
        object.__setattr__(self, "means", means)
        for name, shape in shapes.items():
            value = getattr(self, name)
            if n == 0 and np.size(value) == 0 and np.ndim(value) != len(shape):
                value = np.zeros(empty[name])
            object.__setattr__(self, name, _as_float64(name, value, shape))
        if self.sh.shape[1] not in (1, 4, 9, 16):
            raise ValueError(f"sh has {self.sh.shape[1]} coefficients; it must have 1, 4, 9 or 16")
        _reject("scales", self.scales, self.scales < 0.0, "must be >= 0")
        _reject("opacities", self.opacities, (self.opacities < 0.0) | (self.opacities > 1.0), "must be in [0, 1]")
        # a square could be too small, or too large, for a number
        _reject("quats", self.quats, ~np.any(self.quats, axis=1), "must have a norm > 0")

    def __len__(self) -> int:
        return len(self.means)


def _reject(name: str, array: np.ndarray, bad: np.ndarray, rule: str) -> None:
    where = np.argwhere(bad)
    if len(where):
        index = tuple(int(i) for i in where[0])
        value = array[index]
        raise ValueError(f"{name}{list(index)} is {value.tolist()}; it {rule}")


@dataclass(frozen=True, repr=False)
class Camera(_PrintsAsCode):
    """A pinhole camera in OpenCV's convention (+x right, +y down, +z forward).

    Attributes:
        viewmat: world -> camera, rigid. [4, 4]
        K: intrinsics in px, pixel centres at +0.5, no skew. [3, 3]
        width: px, >= 1.
        height: px, >= 1.
    """

    viewmat: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        viewmat = _as_float64("viewmat", self.viewmat, (4, 4))
        K = _as_float64("K", self.K, (3, 3))
        R = viewmat[:3, :3]
        if np.max(np.abs(R @ R.T - np.eye(3))) > 1e-5 or np.linalg.det(R) < 0.0:
            raise ValueError("viewmat is not rigid: its 3x3 part must be a rotation (orthonormal, determinant +1)")
        if np.max(np.abs(viewmat[3] - np.array([0.0, 0.0, 0.0, 1.0]))) > 0.0:
            raise ValueError(f"viewmat[3] is {viewmat[3].tolist()}; the last row must be [0, 0, 0, 1]")
        if not (K[0, 0] > 0.0 and K[1, 1] > 0.0):
            raise ValueError(f"K has focal lengths {K[0, 0]}, {K[1, 1]}; both must be > 0")
        off = np.array([K[0, 1], K[1, 0], K[2, 0], K[2, 1], K[2, 2] - 1.0])
        if np.any(off != 0.0):
            raise ValueError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
        for name, size in (("width", self.width), ("height", self.height)):
            if isinstance(size, bool) or not isinstance(size, Integral) or size < 1:
                raise ValueError(f"{name} is {size!r}; it must be a whole number of px, >= 1")
        object.__setattr__(self, "viewmat", viewmat)
        object.__setattr__(self, "K", K)


@dataclass(frozen=True, repr=False)
class Splats(_PrintsAsCode):
    """Gaussians as one camera sees them: what tiling and compositing need, still one row per Gaussian.

    Attributes:
        means2d: screen centres, px. [N, 2]
        depths: camera z, world units. [N]
        conics: inverse screen covariances (xx, xy, yy), px^-2; zero where culled. [N, 3]
        opacities: the opacity that blends, after the antialiasing factor if any. [N]
        colors: any number of channels. [N, D]
        radii: extents in px along x and y; both 0 where culled. [N, 2]
    """

    means2d: Float64[np.ndarray, "N 2"]
    depths: Float64[np.ndarray, " N"]
    conics: Float64[np.ndarray, "N 3"]
    opacities: Float64[np.ndarray, " N"]
    colors: Float64[np.ndarray, "N D"]
    radii: Int64[np.ndarray, "N 2"]

    @property
    def visible(self) -> Bool[np.ndarray, " N"]:
        """Tell which splats survived every cull: both extents > 0. [N]"""
        return np.all(self.radii > 0, axis=1)


@dataclass(frozen=True, repr=False)
class Render(_PrintsAsCode):
    """One rendered view and everything that was decided on the way.

    Attributes:
        image: colours over the background, not clamped. [H, W, D]
        T_final: transmittance after the last blended splat. [H, W]
        dominant_ids: the splat with the largest weight, -1 where none was blended. [H, W]
        dominant_weights: that largest weight, 0 where none was blended. [H, W]
        dominant_counts: pixels that each Gaussian dominates. [N]
        n_blended: splats blended at the pixel. [H, W]
        n_traversed: tile-list entries visited until the pixel stopped, the terminating one included. [H, W]
        splats: the projected Gaussians.
        tile_lists: ids front to back, one list a tile, tiles in row-major order.
    """

    image: Float64[np.ndarray, "H W D"]
    T_final: Float64[np.ndarray, "H W"]
    dominant_ids: Int64[np.ndarray, "H W"]
    dominant_weights: Float64[np.ndarray, "H W"]
    dominant_counts: Int64[np.ndarray, " N"]
    n_blended: Int64[np.ndarray, "H W"]
    n_traversed: Int64[np.ndarray, "H W"]
    splats: Splats
    tile_lists: list[list[int]]
