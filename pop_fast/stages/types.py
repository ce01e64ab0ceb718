"""Gaussians and a camera as tensors; meaning, names and shapes are those of `pop_ref.records`."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """Activated Gaussians of a scene; see `pop_ref.records.Gaussians`.

    Attributes:
        means: centres, world units. [N, 3]
        quats: rotations wxyz, any norm > 0. [N, 4]
        scales: standard deviations, world units. [N, 3]
        opacities: in [0, 1]. [N]
        sh: coefficients. [N, n_sh, 3]
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV's convention; see `pop_ref.records.Camera`.

    Attributes:
        viewmat: world -> camera. [4, 4]
        K: intrinsics, px. [3, 3]
        width: px.
        height: px.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int
