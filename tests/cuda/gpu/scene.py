"""A small scene with photographs of its own, for whole training steps."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

WIDTH, HEIGHT, N, VIEWS, STEPS = 48, 36, 96, 3, 10
LR = {"means": 1.6e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}


@dataclass
class TrainingScene:
    """Raw parameters, cameras and byte photographs, on the CPU.

    Attributes:
        params: by gsplat's keys.
        viewmats: [V, 4, 4]
        Ks: [V, 3, 3]
        photographs: uint8 [H, W, 3] each.
        order: the view of every step.
    """

    params: dict[str, Tensor]
    viewmats: Tensor
    Ks: Tensor
    photographs: list[Tensor]
    order: list[int]


def training_scene(seed: int = 3) -> TrainingScene:
    """Make the scene from a seed."""
    g = torch.Generator().manual_seed(seed)
    params = {
        "means": torch.rand((N, 3), generator=g) * torch.tensor([4.0, 3.0, 2.0]) - torch.tensor([2.0, 1.5, -3.0]),
        "scales": torch.randn((N, 3), generator=g) * 0.25 - 1.75,
        "quats": torch.randn((N, 4), generator=g),
        "opacities": torch.randn(N, generator=g),
        "sh0": torch.randn((N, 1, 3), generator=g) * 0.5,
        "shN": torch.randn((N, 15, 3), generator=g) * 0.05,
    }
    viewmats = torch.eye(4).repeat(VIEWS, 1, 1)
    viewmats[:, 0, 3] = torch.tensor([-0.25, 0.0, 0.25])
    K = torch.tensor([[40.0, 0.0, WIDTH / 2], [0.0, 40.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    rows, cols = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    waves = [
        torch.stack([torch.sin((cols + 9 * v) / (4.0 + c)) * torch.cos(rows / 5.0) for c in range(3)], -1)
        for v in range(3)
    ]
    photographs = [((wave * 0.5 + 0.5) * 255).round().to(torch.uint8) for wave in waves]
    return TrainingScene(params, viewmats, K.repeat(VIEWS, 1, 1), photographs, [k % VIEWS for k in range(STEPS)])
