"""Make the first Gaussians of a scene from the sparse points of its capture."""

from __future__ import annotations

import math

import numpy as np
import torch

from pop_fast.data.capture import Capture
from pop_fast.errors import CaptureError
from pop_fast.stages.density import mean_squared_distances

__all__ = ["SH_C0", "initialize_params"]

SH_C0 = 0.28209479177387814


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
