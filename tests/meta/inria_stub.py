"""diff-gaussian-rasterization's interface, as its users know it, on top of pop_fast: what its adapter is tested with.

It insists on what Inria's code takes for granted: transposed matrices that belong together, unit quaternions, shapes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from pop_fast.api.rasterize import rasterization
from pop_ref.constants import INRIA


class GaussianRasterizationSettings(NamedTuple):
    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool
    antialiasing: bool


class GaussianRasterizer(torch.nn.Module):
    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def forward(
        self,
        means3D: Tensor,
        means2D: Tensor,
        opacities: Tensor,
        shs: Tensor | None = None,
        colors_precomp: Tensor | None = None,
        scales: Tensor | None = None,
        rotations: Tensor | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        s = self.raster_settings
        n = len(means3D)
        assert (shs is None) != (colors_precomp is None)
        assert cov3D_precomp is None
        assert scales is not None
        assert rotations is not None
        assert means2D.shape == (n, 3)
        assert opacities.shape == (n, 1)
        # the kernels do not normalise
        assert torch.allclose(rotations.norm(dim=1), torch.ones_like(rotations[:, 0]), atol=1e-6)
        colors = shs if shs is not None else colors_precomp
        assert colors is not None
        given = (means3D, means2D, opacities, colors, scales, rotations)
        image, radii = _Drawn.apply(*given, s, shs is not None)
        return image, radii, torch.zeros_like(image[:1])


class _Drawn(torch.autograd.Function):
    """The render; its gradient of a screen centre is in halves of the image, as Inria's is."""

    @staticmethod
    def forward(ctx: Any, *given: Any) -> Any:
        *tensors, s, harmonics = given
        with torch.enable_grad():
            leaves = [tensor.detach().requires_grad_(True) for tensor in tensors]
            image, meta = _rasterized(leaves, s, harmonics)
        ctx.graph = image, [leaves[0], meta["means2d"], *leaves[2:]], (s.image_width, s.image_height)
        radii = meta["radii"][0].amax(dim=1).int()
        ctx.mark_non_differentiable(radii)
        return image[0].permute(2, 0, 1).detach(), radii

    @staticmethod
    def backward(ctx: Any, *v: Any) -> Any:
        image, wrt, size = ctx.graph
        v_means, v_points, *rest = torch.autograd.grad(
            image, wrt, v[0].permute(1, 2, 0)[None], allow_unused=True, materialize_grads=True
        )
        halves = v_points[0] * 0.5 * torch.tensor(size, dtype=v_points.dtype)
        return v_means, torch.nn.functional.pad(halves, (0, 1)), *rest, None, None


def _rasterized(leaves: list[Tensor], s: GaussianRasterizationSettings, harmonics: bool) -> tuple[Tensor, Any]:
    means, _, opacities, colors, scales, rotations = leaves
    viewmat = s.viewmatrix.T
    half = torch.tensor([0.5 * s.image_width, 0.5 * s.image_height], dtype=means.dtype)
    focal = half / torch.tensor([s.tanfovx, s.tanfovy], dtype=means.dtype)
    _check_camera(s, viewmat, focal, half)
    K = torch.eye(3, dtype=means.dtype)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = *focal, *half
    image, _, meta = rasterization(
        means,
        rotations,
        scales * s.scale_modifier,
        opacities[:, 0],
        colors,
        viewmat[None],
        K[None],
        s.image_width,
        s.image_height,
        near_plane=INRIA.near_plane,
        sh_degree=s.sh_degree if harmonics else None,
        packed=False,
        backgrounds=s.bg[None],
        rasterize_mode="antialiased" if s.antialiasing else "classic",
        profile="inria",
    )
    return image, meta


def _check_camera(s: GaussianRasterizationSettings, viewmat: Tensor, focal: Tensor, half: Tensor) -> None:
    # a point through the projection matrix lands where the pinhole puts it, and the camera stands at campos
    there = torch.tensor([0.3, -0.2, 2.0, 1.0], dtype=viewmat.dtype)
    world = torch.linalg.solve(viewmat, there)
    clip = world @ s.projmatrix
    assert torch.allclose(clip[:2] / clip[3] * half + half, focal * there[:2] / there[2] + half, atol=1e-3)
    assert torch.allclose(viewmat[:3, :3] @ s.campos, -viewmat[:3, 3], rtol=1e-4, atol=1e-4)
