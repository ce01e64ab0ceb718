"""What the GPU is timed on: synthetic scenes with the loads of trained ones, and trained scenes themselves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pop_fast.cli.splat import CaptureOptions, load_splat, open_capture


@dataclass(frozen=True)
class GpuCase:
    """How much there is to draw.

    Attributes:
        name: of the case.
        n: Gaussians.
        width, height: px.
        size: median standard deviation on the screen, px; 0 for a trained scene, which is not made from it.
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


def trained_scene(folder: Path, device: torch.device) -> tuple[GpuCase, dict[str, Tensor]]:
    """Return the last checkpoint of a `pop train` result, as its first held-out view sees it, and its case.

    Raises:
        PopError: the folder is no result, or its capture is not where it was.
    """
    splat = load_splat(folder)
    capture, config = open_capture(splat, CaptureOptions())
    view = (*capture.test_views(config.test_every), *capture.views)[0]
    p = {name: value.to(device) for name, value in splat.params.items()}
    shN = torch.zeros((len(p["means"]), 15, 3), device=device)
    shN[:, : p["shN"].shape[1]] = p["shN"]
    scene = {
        "means": p["means"],
        "quats": p["quats"],
        "scales": p["scales"].exp(),
        "opacities": p["opacities"].sigmoid(),
        "sh": torch.cat((p["sh0"], shN), 1),
        "viewmats": torch.tensor(view.viewmat, dtype=torch.float32, device=device)[None],
        "Ks": torch.tensor(view.K, dtype=torch.float32, device=device)[None],
    }
    return GpuCase(folder.name, len(p["means"]), view.width, view.height, 0.0), scene
