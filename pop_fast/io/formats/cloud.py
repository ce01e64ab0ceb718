"""Gaussians as the file formats see them: NumPy rows in the frame and the units of the PLY layout.

The frame of PLY files of splats has y down and z forward, as COLMAP's cameras have. Formats whose frame has y up turn
the scene by half a turn about an axis, which only changes signs: of two coordinates, of two components of every
quaternion, and of the colour coefficients that are odd in those two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.errors import PopError
from pop_fast.io.ply import Frame, checked_params

SH_C0: Final = 0.28209479177387814
# columns of f_rest by degree, over three
COEFFICIENTS: Final = (0, 3, 8, 15)
# in which of x, y, z each colour function beyond degree 0 is odd
_ODD: Final = (
    *("y", "z", "x"),
    *("xy", "yz", "", "xz", ""),
    *("y", "xyz", "y", "z", "x", "z", "x"),
)
# a stored opacity of 255 of 255 stands for the last half step below 1, one of 0 for the first above 0: in the middle
_QUARTER_STEP: Final = 0.25 / 255.0
# the logarithm of what a float32 holds, nearly
_LARGEST: Final = 88.7
_FIELDS: Final = ("means", "log_scales", "quats", "logits", "sh0", "rest")


@dataclass(frozen=True)
class Cloud:
    """Gaussians with raw parameters, float32."""

    means: np.ndarray  # centres, world units. [N, 3]
    log_scales: np.ndarray  # [N, 3]
    quats: np.ndarray  # wxyz, of norm 1. [N, 4]
    logits: np.ndarray  # of the opacities. [N]
    sh0: np.ndarray  # colour of degree 0. [N, 3]
    rest: np.ndarray  # colours of the higher degrees. [N, 0|3|8|15, 3]
    antialiased: bool = False  # to be drawn with antialiasing
    frame: Frame | None = None  # the world that they are in, where it is known

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        return COEFFICIENTS.index(self.rest.shape[1])

    @property
    def opacities(self) -> np.ndarray:
        """Opacities in [0, 1]. float64 [N]"""
        return 0.5 * (1.0 + np.tanh(0.5 * self.logits.astype(np.float64)))

    @property
    def scales(self) -> np.ndarray:
        """Standard deviations, no larger than a float32 can be. float64 [N, 3]"""
        return np.exp(np.minimum(self.log_scales.astype(np.float64), _LARGEST))

    @property
    def visibility(self) -> np.ndarray:
        """Guess how much each is seen: its opacity times the root of its largest cross-section. float64 [N]"""
        scales = np.sort(self.scales, axis=1)
        return self.opacities * np.sqrt(scales[:, 1] * scales[:, 2])

    @classmethod
    def of(cls, params: Mapping[str, Tensor], antialiased: bool = False, frame: Frame | None = None) -> Cloud:
        """Take over raw parameters; colour degrees in which all coefficients are exactly 0 are left out."""
        arrays = checked_params(dict(params))
        quats = arrays["quats"].astype(np.float64)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        used = np.flatnonzero(arrays["shN"].any(axis=(0, 2)))
        bands = min(n for n in COEFFICIENTS if n > (used[-1] if len(used) else -1))
        return cls(
            means=arrays["means"],
            log_scales=arrays["scales"],
            quats=quats.astype(np.float32),
            logits=arrays["opacities"],
            sh0=arrays["sh0"][:, 0],
            rest=np.ascontiguousarray(arrays["shN"][:, :bands]),
            antialiased=antialiased,
            frame=frame,
        )

    def params(self) -> dict[str, Tensor]:
        """Return raw parameters, as `pop_fast.io.ply.load_ply` does: shN is [N, 15, 3], padded with zeros."""
        rest = np.zeros((len(self), 15, 3), np.float32)
        rest[:, : self.rest.shape[1]] = self.rest
        arrays = {
            "means": self.means,
            "scales": self.log_scales,
            "quats": self.quats,
            "opacities": self.logits,
            "sh0": self.sh0[:, None, :],
            "shN": rest,
        }
        return {name: torch.from_numpy(np.array(value, np.float32)) for name, value in arrays.items()}

    def take(self, rows: np.ndarray) -> Cloud:
        return replace(self, **{name: getattr(self, name)[rows] for name in _FIELDS})

    def turned(self, axis: str) -> Cloud:
        """Turn the scene by half a turn about the "x" or the "z" axis; exact, and its own inverse."""
        minus = "".join(name for name in "xyz" if name != axis)
        signs = np.array([-1.0 if name in minus else 1.0 for name in "xyz"], np.float32)
        odd = np.array([sum(name in minus for name in names) % 2 for names in _ODD], bool)[: self.rest.shape[1]]
        rest = np.where(odd[None, :, None], -self.rest, self.rest)
        quats = self.quats * np.concatenate([[np.float32(1.0)], signs])
        return replace(self, means=self.means * signs, quats=quats, rest=rest)

    def checked(self, path: Path) -> Cloud:
        """Return this as it was read from a file, if all of it can be drawn; a PopError names file, row and field."""
        for name in _FIELDS:
            bad = np.argwhere(~np.isfinite(getattr(self, name)))
            if len(bad):
                row, value = int(bad[0][0]), getattr(self, name)[tuple(bad[0])]
                raise PopError(f"{path}: {name} of Gaussian {row} is {value}; it must be finite: write the file again")
        norms = np.linalg.norm(self.quats.astype(np.float64), axis=1)
        if len(norms) and norms.min() < 1e-6:
            raise PopError(f"{path}: the rotation of Gaussian {int(norms.argmin())} is zero; write the file again")
        return replace(self, quats=(self.quats / np.maximum(norms, 1e-6)[:, None]).astype(np.float32))


def logits_of_bytes(stored: np.ndarray) -> np.ndarray:
    """Return the logits of opacities that are stored as bytes; of 0 and 255 too they are finite. float32 [N]"""
    shares = np.clip(stored.astype(np.float64) / 255.0, _QUARTER_STEP, 1.0 - _QUARTER_STEP)
    return np.log(shares / (1.0 - shares)).astype(np.float32)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Round to the nearest of 0 to 255. uint8, of the same shape"""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def morton_order(means: np.ndarray) -> np.ndarray:
    """Order centres [N, 3] along a space-filling curve, so that neighbours in the file are neighbours in space.

    Far-away centres are pulled in by a logarithm first: a few of them would leave the rest in one cell. A permutation,
    ties in the order they have. int64 [N]
    """
    if len(means) == 0:
        return np.zeros(0, np.int64)
    offsets = means.astype(np.float64) - np.median(means, axis=0)
    spread = max(float(np.median(np.abs(offsets))), 1e-12)
    near = np.sign(offsets) * np.log1p(np.abs(offsets) / spread)
    low, high = near.min(axis=0), near.max(axis=0)
    cells = ((near - low) / np.maximum(high - low, 1e-12) * (2**21 - 1)).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(21):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def drop_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out the component of the largest magnitude of unit quaternions, after a change of sign that makes it > 0.

    Returns:
        Which was left out, int64 [N], and the others in order, within sqrt(1/2) of 0. float64 [N, 3]
    """
    largest = np.abs(quats).argmax(axis=1)
    rows = np.arange(len(quats))
    signed = quats.astype(np.float64) * np.where(quats[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    return largest, signed[others(largest)].reshape(len(quats), 3)


def restore_largest(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Invert `drop_largest`. float64 [N, 4]"""
    quats = np.empty((len(three), 4))
    quats[others(largest)] = three.reshape(-1)
    quats[np.arange(len(three)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (three**2).sum(axis=1)))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def others(largest: np.ndarray) -> np.ndarray:
    """Mark the components that are kept. bool [N, 4]"""
    return np.arange(4)[None, :] != largest[:, None]
