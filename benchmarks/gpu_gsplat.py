"""gsplat's training iteration on the same tensors, built to its advantage.

Its rasterization under autograd, as its trainer calls it, and torch's fused Adam. For the loss it is given this
project's own kernel, which its wheel has nothing to match with, so that the ratio tells of the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from gpu_scenes import GpuCase
from gpu_steps import raw_params
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import fill, new_state, stream_of
from cuda_ext.resident import MARGIN, ResidentViews

LAMBDA_SSIM = 0.01


class FusedLoss:
    """L2 + D-SSIM of one photograph: fills the image's cotangent."""

    def __init__(self, scene: dict[str, Tensor], photograph: Tensor) -> None:
        kernels, device = load(), scene["means"].device
        height, width = photograph.shape[:2]
        self._views = ResidentViews([photograph], scene["viewmats"], scene["Ks"], None, "valid", device)
        self._state = new_state(device)
        self._arrays: dict[str, Any] = {
            "windows": torch.empty((9, height, width), device=device),
            "partials": torch.empty((kernels.loss_blocks(width, height), 3), device=device),
            "v_image": torch.empty((height, width, 3), device=device),
            "values": torch.zeros(kernels.N_VALUES, device=device),
            "width": width,
            "height": height,
        }
        self._settings = fill(kernels.LossSettings(), pixelwise_weight=1.0 - LAMBDA_SSIM, ssim_weight=LAMBDA_SSIM)
        self._settings.margin = MARGIN
        self._settings.set_pixelwise(False)

    def v_image(self, image: Tensor) -> Tensor:
        """Return the objective's gradient to an image. [H, W, 3]"""
        arrays = fill(load().LossArrays(), image=image, **self._arrays)
        stream = stream_of(image.device)
        load().photometric(self._views.photographs(), arrays, self._settings, self._state.data_ptr(), stream)
        return self._arrays["v_image"]


def gsplat_iteration(
    rasterization: Callable[..., Any],
    scene: dict[str, Tensor],
    case: GpuCase,
    photograph: Tensor,
    timed: Callable[[Callable[[], Any]], float],
) -> dict[str, float]:
    """Time loss, optimizer and whole iteration."""
    params = {name: value.requires_grad_() for name, value in raw_params(scene).items()}
    optimizers = [torch.optim.Adam([value], lr=1e-9, eps=1e-15, fused=True) for value in params.values()]
    loss = FusedLoss(scene, photograph)

    def render() -> Tensor:
        scales, opacities = torch.exp(params["scales"]), torch.sigmoid(params["opacities"])
        sh = torch.cat((params["sh0"], params["shN"]), 1)
        views = (scene["viewmats"], scene["Ks"], case.width, case.height)
        return rasterization(
            params["means"], params["quats"], scales, opacities, sh, *views, sh_degree=3, packed=False
        )[0]

    def update() -> None:
        for optimizer in optimizers:
            optimizer.step()

    def iteration() -> None:
        image = render()
        image.backward(loss.v_image(image.detach()[0].contiguous())[None])
        update()
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)

    whole = timed(iteration)
    image = render()
    image.backward(torch.zeros_like(image))
    fixed = image.detach()[0].contiguous()
    return {"step_ms": whole, "optimizer_ms": timed(update), "loss_ms": timed(lambda: loss.v_image(fixed))}
