"""Move a whole splat from one world frame into another: positions, rotations, sizes and colours."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from pop_fast.harmonics import sh_basis

_DIRECTIONS = 64


def move_params(params: Mapping[str, Tensor], transform: Tensor) -> dict[str, Tensor]:
    """Apply a similarity to raw parameters: x' = s R x + t.

    Means take all of it, log-scales add log s, quaternions are turned by R, and the bands of the harmonics are rotated,
    so that the moved splat seen from a moved camera is the same picture.

    Args:
        params: `means, scales, quats, opacities, sh0, shN`, raw (log-scales, logits).
        transform: the similarity, new frame from old. [4, 4]

    Returns:
        New parameters under the same keys and dtypes; opacities and the constant band are the same tensors.

    Raises:
        ValueError: `transform` is not a similarity with positive scale.
    """
    matrix = transform.double()
    scale = float(torch.linalg.det(matrix[:3, :3]).clamp_min(0.0)) ** (1.0 / 3.0)
    rotation = matrix[:3, :3] / scale if scale > 0.0 else matrix[:3, :3]
    if scale <= 0.0 or not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-6):
        raise ValueError("transform is not a similarity; its 3x3 part must be a rotation times a positive scale")
    means = params["means"]
    moved = dict(params)
    moved["means"] = (means.double() @ matrix[:3, :3].T + matrix[:3, 3]).to(means.dtype)
    moved["scales"] = params["scales"] + math.log(scale)
    moved["quats"] = _turn_quats(params["quats"], rotation)
    moved["shN"] = _turn_bands(params["shN"], rotation)
    return moved


def _turn_quats(quats: Tensor, rotation: Tensor) -> Tensor:
    w, x, y, z = _quat_from_rotation(rotation)
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    return (quats.double() @ left.T).to(quats.dtype)


def _quat_from_rotation(rotation: Tensor) -> list[float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation.numpy()).as_quat().tolist()
    return [w, x, y, z]


def _turn_bands(bands: Tensor, rotation: Tensor) -> Tensor:
    """Rotate bands 1 and up: find, band by band, the matrix M with basis(R d) M = basis(d) for all directions d."""
    degree = math.isqrt(bands.shape[1] + 1) - 1
    if degree == 0:
        return bands
    dirs = _fibonacci_directions(_DIRECTIONS)
    before, after = sh_basis(dirs, degree), sh_basis(dirs @ rotation.T, degree)
    turned = torch.empty_like(bands)
    for band in range(1, degree + 1):
        columns = slice(band * band, (band + 1) * (band + 1))
        matrix = torch.linalg.lstsq(after[:, columns], before[:, columns]).solution
        rows = slice(columns.start - 1, columns.stop - 1)
        turned[:, rows] = torch.einsum("ij,njc->nic", matrix, bands[:, rows].double()).to(bands.dtype)
    return turned


def _fibonacci_directions(n: int) -> Tensor:
    i = torch.arange(n, dtype=torch.float64)
    z = 1.0 - (2.0 * i + 1.0) / n
    turn = math.pi * (3.0 - math.sqrt(5.0)) * i
    return torch.stack([torch.sqrt(1.0 - z * z) * torch.cos(turn), torch.sqrt(1.0 - z * z) * torch.sin(turn), z], dim=1)
