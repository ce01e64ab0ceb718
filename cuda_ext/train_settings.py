"""What a fused training step depends on, and what it tells density control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pop_ref.constants import PAPER, Profile

# in the kernels' order (csrc/train.h)
GROUPS = ("means", "scales", "quats", "opacities", "sh0", "shN")


@dataclass(frozen=True)
class StepSettings:
    """What the objective and the update depend on.

    Attributes:
        lr: learning rate by parameter; that of the means already times the scene's scale.
        max_steps: length of the schedule.
        means_decay: what the means' rate falls to.
        lambda_ssim, padding: weight and border of D-SSIM.
        lambda_pop: weight of the POP term where it is on.
        theta_blur: share of the image a Gaussian must dominate to be blurred.
        l1: L1 instead of L2.
        profile, antialiased, family, deterministic: as in `cuda_ext.ops.rasterization`.
        betas, eps: Adam's.
    """

    lr: Mapping[str, float]
    max_steps: int
    means_decay: float = 0.01
    lambda_ssim: float = 0.01
    padding: str = "valid"
    lambda_pop: float = 0.001
    theta_blur: float = 2e-5
    l1: bool = False
    profile: Profile = PAPER
    antialiased: bool = False
    family: str = "columns"
    deterministic: bool = True
    betas: tuple[float, float] = (0.9, 0.999)
    eps: float = 1e-15


class Phase(NamedTuple):
    """What one kind of step does; steps of one phase and one image size share a graph."""

    sh_degree: int
    pop: bool
    statistics: bool


@dataclass
class Statistics:
    """What density control reads, one entry a Gaussian, added to by every step of a phase with statistics."""

    grad_sum: Tensor
    n_visible: Tensor
    dominant_sum: Tensor
    blurred: Tensor

    @classmethod
    def zeros(cls, n: int, device: torch.device) -> Statistics:
        """Start from nothing."""
        visible, dominant = (torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2))
        flags = torch.zeros(n, dtype=torch.uint8, device=device)
        return cls(torch.zeros(n, device=device), visible, dominant, flags)
