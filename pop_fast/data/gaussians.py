"""Between a capture and its Gaussians: the first ones, made of its points; trained ones, moved into its own frame."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pop_fast.data.capture import Capture
from pop_fast.errors import CaptureError, PopError
from pop_fast.io.formats.cloud import SH_C0
from pop_fast.stages.density import mean_squared_distances
from pop_fast.stages.harmonics import sh_basis


def initialize_params(
    capture: Capture,
    seed: int = 0,
    init_opacity: float = 0.1,
    init_scale: float = 1.0,
    dtype: torch.dtype = torch.float32,
) -> dict[str, torch.Tensor]:
    """Make raw parameters, one isotropic Gaussian a point.

    scales = log(init_scale * sqrt(mean squared distance to the three nearest other points)), quats uniform in [0, 1)^4,
    opacities = logit(init_opacity), sh0 = (rgb - 1/2) / 0.28209479177387814, shN = 0. The mean squared distance is kept
    at 1e-7 scene_scale^2 or more, so that points that coincide get a size.

    Source: gsplat v1.5.3, examples/simple_trainer.py (which does not clamp); the clamp is 3DGS's, made free of units.

    Args:
        capture: its points and their colours.
        seed: of the quaternions.
        init_opacity: in (0, 1).
        init_scale: factor on the standard deviations.
        dtype: of the result.

    Returns:
        means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 15, 3]: raw, on the CPU.
    """
    n = len(capture.points)
    if n == 0:
        raise CaptureError(f"{capture.name}: has no points to start from; load it again, random points are made then")
    if not 0.0 < init_opacity < 1.0:
        raise CaptureError(f"init_opacity is {init_opacity}; it must be between 0 and 1")
    squared = np.maximum(mean_squared_distances(capture.points), 1e-7 * capture.scene_scale() ** 2)
    sizes = np.log(init_scale * np.sqrt(squared))
    generator = torch.Generator().manual_seed(seed)
    sh0 = (capture.points_rgb.astype(np.float64) / 255.0 - 0.5) / SH_C0
    return {
        "means": torch.tensor(capture.points, dtype=dtype),
        "scales": torch.tensor(sizes, dtype=dtype)[:, None].repeat(1, 3),
        "quats": torch.rand(n, 4, generator=generator, dtype=dtype),
        "opacities": torch.full((n,), math.log(init_opacity / (1.0 - init_opacity)), dtype=dtype),
        "sh0": torch.tensor(sh0, dtype=dtype)[:, None, :],
        "shN": torch.zeros(n, 15, 3, dtype=dtype),
    }


def to_capture_frame(params: dict[str, torch.Tensor], world_transform: np.ndarray) -> dict[str, torch.Tensor]:
    """Undo the normalisation of a capture: `apply_similarity` with the inverse of `Capture.world_transform`."""
    return apply_similarity(params, np.linalg.inv(world_transform))


def apply_similarity(params: dict[str, torch.Tensor], transform: np.ndarray) -> dict[str, torch.Tensor]:
    """Move raw Gaussians so that they look the same from cameras moved likewise.

    With R, s, t of the similarity: means' = s R means + t, scales' = scales + log s, quats' = q_R quats, and every band
    of the spherical harmonics is turned with the scene. Opacities stay.

    Args:
        params: means [N, 3], scales [N, 3], quats [N, 4], opacities [N], sh0 [N, 1, 3], shN [N, 0|3|8|15, 3], raw.
        transform: [4, 4] similarity, new world from old.

    Returns:
        New tensors of the same dtypes; computed in float64.

    Raises:
        PopError: the matrix is no similarity.
    """
    scale, rotation = _parts(np.asarray(transform, np.float64))
    R = torch.from_numpy(rotation)
    moved = {name: value.detach().to(torch.float64) for name, value in params.items()}
    moved["means"] = scale * moved["means"] @ R.T + torch.from_numpy(np.array(transform[:3, 3], np.float64))
    moved["scales"] = moved["scales"] + float(np.log(scale))
    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    moved["quats"] = moved["quats"] @ product.T
    moved["shN"] = rotate_sh(torch.cat([moved["sh0"], moved["shN"]], dim=1), rotation)[:, 1:]
    return {name: value.to(params[name].dtype) for name, value in moved.items()}


def rotate_sh(sh: torch.Tensor, rotation: np.ndarray) -> torch.Tensor:
    """Turn spherical harmonics [N, 1|4|9|16, 3]: the colour along R d afterwards is the colour along d before.

    A band of degree l is closed under rotations, so M_l in basis_l(R d) M_l = basis_l(d) exists and is orthogonal; it
    is solved from more directions than the band has functions.
    """
    degree = int(np.sqrt(sh.shape[1])) - 1
    directions = torch.from_numpy(_directions(32))
    before = sh_basis(directions, degree)
    after = sh_basis(directions @ torch.from_numpy(np.ascontiguousarray(rotation.T)), degree)
    turned = sh.clone()
    for band in range(degree + 1):
        rows = slice(band * band, (band + 1) * (band + 1))
        matrix = torch.linalg.lstsq(after[:, rows], before[:, rows]).solution
        turned[:, rows] = matrix @ sh[:, rows]
    return turned


def _directions(count: int) -> np.ndarray:
    """Spread unit vectors evenly over the sphere: a Fibonacci spiral. float64 [count, 3]"""
    i = np.arange(count)
    z = 1.0 - (2.0 * i + 1.0) / count
    turn = i * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def _parts(transform: np.ndarray) -> tuple[float, np.ndarray]:
    if transform.shape != (4, 4) or not np.all(np.isfinite(transform)):
        raise PopError(f"transform has shape {list(transform.shape)} or NaN; it must be a finite 4x4 similarity")
    determinant = float(np.linalg.det(transform[:3, :3]))
    scale = float(np.cbrt(determinant))
    rotation = transform[:3, :3] / scale if determinant > 0.0 else np.zeros((3, 3))
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.any(transform[3] != [0.0, 0.0, 0.0, 1.0]):
        raise PopError("transform is not a similarity: its 3x3 part must be a positive scale times a rotation")
    return scale, rotation
