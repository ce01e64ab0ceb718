"""Synthetic scenes for the GPU with the loads of trained ones: Gaussians, pixels and list lengths in the same range."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class GpuCase:
    """How much there is to draw.

    Attributes:
        name: of the case.
        n: Gaussians.
        width, height: px.
        size: median standard deviation on the screen, px.
    """

    name: str
    n: int
    width: int
    height: int
    size: float


CASES = (
    GpuCase("270k_1.6MP", 270_000, 1552, 1032, 6.0),
    GpuCase("1M_1.6MP", 1_000_000, 1552, 1032, 3.0),
    GpuCase("3M_1.6MP", 3_000_000, 1552, 1032, 1.75),
)


def activated_scene(case: GpuCase, device: torch.device, seed: int = 0) -> dict[str, Tensor]:
    """Return means, quats, scales, opacities, sh, viewmats and Ks on the device, activated."""
    g = torch.Generator(device=device).manual_seed(seed)
    focal = 0.8 * case.width

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=g, device=device)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=g, device=device)

    depth = 2.0 + 8.0 * uniform(case.n)
    x = (uniform(case.n) * 1.2 - 0.6) * case.width / focal * depth
    y = (uniform(case.n) * 1.2 - 0.6) * case.height / focal * depth
    # log-normal sizes, anisotropic, in pixels at the Gaussian's depth
    scales = (case.size * torch.exp(0.7 * normal(case.n, 3))) * (depth / focal)[:, None]
    sh = 0.1 * normal(case.n, 16, 3)
    sh[:, 0] = 1.5 * normal(case.n, 3)
    K = torch.tensor([[focal, 0, case.width / 2], [0, focal, case.height / 2], [0, 0, 1.0]], device=device)
    return {
        "means": torch.stack((x, y, depth), 1),
        "quats": normal(case.n, 4),
        "scales": scales,
        # polarised, as POP leaves them: half near one, half low
        "opacities": torch.where(uniform(case.n) < 0.5, 0.9 + 0.1 * uniform(case.n), 0.3 * uniform(case.n)),
        "sh": sh,
        "viewmats": torch.eye(4, device=device)[None],
        "Ks": K[None],
    }
