"""One camera's render in layers: colour, opacity, depth and dominant Gaussians; for the report and the live viewer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors, rasterization_arguments


@dataclass(frozen=True, eq=False)
class Layers:
    """What one camera sees.

    Attributes:
        image: encoded RGB, not clamped. float32 [H, W, 3]
        alpha: 1 - T_final, how much of the background is covered. float32 [H, W]
        depth: mean camera z of what is blended, by weight; world units, 0 where nothing is. float32 [H, W]
        dominant_ids: the Gaussian with the largest weight, -1 none; None where it was not asked for. int [H, W]
    """

    image: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray
    dominant_ids: np.ndarray | None


@torch.no_grad()
def render_layers(
    backend: Any,
    params: Mapping[str, Tensor],
    view: ViewTensors,
    config: TrainConfig,
    sh_degree: int,
    dominance: bool = False,
) -> Layers:
    """Render colour and depth of a camera in one pass.

    Args:
        backend: what renders.
        params: raw parameters.
        view: the camera; its photograph gives the size alone.
        config: background, profile and antialiasing are read.
        sh_degree: highest active colour band.
        dominance: also find the dominant Gaussians.
    """
    given = rasterization_arguments(params, view, config, sh_degree)
    drawn, alphas, info = backend.rasterization(**given, render_mode="RGB+ED", dominance=dominance)
    found = drawn[0].cpu().numpy()
    ids = info["dominant_ids"][0].cpu().numpy() if dominance else None
    return Layers(found[..., :3], alphas[0, ..., 0].cpu().numpy(), found[..., 3], ids)
