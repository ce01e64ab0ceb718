"""A scene for passes over views: raw parameters, and two small views of it."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pop_fast.train.views import ViewTensors

WIDTH, HEIGHT = 37, 22


def raw_params(n: int = 60, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    """Scatter Gaussians before the cameras: some opaque, some hardly visible, two behind and beside them."""
    generator = torch.Generator().manual_seed(1)

    def normal(*size: int) -> Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64)

    means = normal(n, 3) * torch.tensor([1.0, 1.0, 0.5]) + torch.tensor([0.0, 0.0, 4.0])
    means[0], means[1] = torch.tensor([0.1, 0.0, -4.0]), torch.tensor([40.0, 0.0, 4.0])
    params = {
        "means": means,
        "scales": 0.6 * normal(n, 3) - 1.5,
        "quats": normal(n, 4),
        "opacities": 3.0 * normal(n) + 1.0,
        "sh0": normal(n, 1, 3),
        "shN": 0.2 * normal(n, 15, 3),
    }
    return {name: value.to(dtype) for name, value in params.items()}


def views(dtype: torch.dtype = torch.float64) -> list[ViewTensors]:
    """Look along z, and from a little to the side with a mask."""
    photos = torch.randint(0, 256, (2, HEIGHT, WIDTH, 3), generator=torch.Generator().manual_seed(2)).to(torch.uint8)
    K = torch.tensor([[40.0, 0.0, 20.0], [0.0, 42.0, 12.0], [0.0, 0.0, 1.0]], dtype=dtype)[None]
    viewmat = torch.eye(4, dtype=dtype)[None]
    first = ViewTensors("first", photos[0], None, viewmat, K)
    turned = viewmat.clone()
    turned[0, :3, :3] = torch.tensor([[0.96, 0.0, -0.28], [0.0, 1.0, 0.0], [0.28, 0.0, 0.96]], dtype=dtype)
    turned[0, :3, 3] = torch.tensor([1.0, 0.2, 0.1], dtype=dtype)
    mask = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[:, 20:] = False
    return [first, replace(first, name="second", photo=photos[1], mask=mask, viewmat=turned)]
