"""An adapter for diff-gaussian-rasterization, Inria's CUDA rasterizer: its interface under gsplat's signature.

Inria's takes transposed matrices, tangents of half the field of view and unit quaternions, returns the image channels
first, and shows neither alpha nor screen centres; the remaining transmittance is what a second render of black splats
shows of a white background. Background and view matrix have no gradients there. Nothing of it is imported unasked.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from pop_ref.conformance.capabilities import ANTIALIASING
from pop_ref.conformance.torch_adapter import TorchAdapter
from pop_ref.constants import INRIA

MODULE = "diff_gaussian_rasterization"
# planes of its projection matrix; they move neither a pixel nor the near-plane test, which is on camera z
NEAR, FAR = 0.01, 100.0


def gsplat_like(module: Any) -> Callable[..., Any]:
    """Return the module's rasterizer as a function of gsplat's arguments, for one camera.

    Args:
        module: has GaussianRasterizationSettings and GaussianRasterizer.
    """
    torch: Any = importlib.import_module("torch")
    blurs = "antialiasing" in module.GaussianRasterizationSettings._fields

    def rasterization(
        means: Any,
        quats: Any,
        scales: Any,
        opacities: Any,
        colors: Any,
        viewmats: Any,
        Ks: Any,
        width: int,
        height: int,
        sh_degree: int | None = None,
        backgrounds: Any = None,
        rasterize_mode: str = "classic",
        **_others: Any,
    ) -> tuple[Any, Any, dict[str, Any]]:
        size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
        points = torch.zeros((len(means), 2), dtype=means.dtype, device=means.device, requires_grad=means.requires_grad)
        # its gradient of a screen centre is in halves of the image
        means2d = torch.nn.functional.pad(points * 2.0 / size, (0, 1))
        common = {
            "means3D": means,
            "means2D": means2d,
            "opacities": opacities[:, None],
            "scales": scales,
            "rotations": torch.nn.functional.normalize(quats),
        }
        antialiased = {"antialiasing": rasterize_mode == "antialiased"} if blurs else {}

        def drawn(background: Any, **chosen: Any) -> Any:
            camera = _camera(torch, viewmats[0].detach(), Ks[0], width, height)
            settings = module.GaussianRasterizationSettings(
                image_height=height,
                image_width=width,
                **camera,
                bg=background,
                scale_modifier=1.0,
                sh_degree=sh_degree,
                prefiltered=False,
                debug=False,
                **antialiased,
            )
            # newer versions return inverse depths as well
            image, radii, *_ = module.GaussianRasterizer(settings)(**common, **chosen)
            return image.permute(1, 2, 0), radii

        image, radii = drawn(backgrounds[0].detach(), shs=colors)
        transmittance, _ = drawn(torch.ones_like(backgrounds[0]), colors_precomp=torch.zeros_like(means))
        meta = {"radii": radii[:, None].repeat(1, 2), **({"means2d": points} if points.requires_grad else {})}
        return image[None], 1.0 - transmittance[None, :, :, :1], meta

    return rasterization


def _camera(torch: Any, viewmat: Any, K: Any, width: int, height: int) -> dict[str, Any]:
    tan_x, tan_y = 0.5 * width / float(K[0, 0]), 0.5 * height / float(K[1, 1])
    projection = torch.zeros((4, 4), dtype=viewmat.dtype, device=viewmat.device)
    projection[0, 0], projection[1, 1], projection[3, 2] = 1.0 / tan_x, 1.0 / tan_y, 1.0
    projection[2, 2], projection[2, 3] = FAR / (FAR - NEAR), -FAR * NEAR / (FAR - NEAR)
    return {
        "tanfovx": tan_x,
        "tanfovy": tan_y,
        "viewmatrix": viewmat.T.contiguous(),
        "projmatrix": (projection @ viewmat).T.contiguous(),
        "campos": -viewmat[:3, :3].T @ viewmat[:3, 3],
    }


def inria(name: str, module: Any = None, dtype: str = "float32", device: str = "cuda") -> TorchAdapter:
    """Return the adapter; by default of the installed package, on the first GPU.

    Raises:
        ModuleNotFoundError: torch or the package is not installed.
    """
    module = importlib.import_module(MODULE) if module is None else module
    without = ("background", "viewmat")
    adapter = TorchAdapter(
        name,
        gsplat_like(module),
        dtype=dtype,
        device=device,
        profile=INRIA,
        without_gradients=without,
        deterministic=False,
        whole_signature=False,
    )
    adapter.able = (ANTIALIASING,) if "antialiasing" in module.GaussianRasterizationSettings._fields else ()
    return adapter
