"""Time gsplat and the CUDA backend, on the same tensors in the same process, one after the other.

    python benchmarks/gpu_gsplat.py out.json [--cases 270k_1.6MP] [--scenes packed/scenes/garden.npz ...]

gsplat's training iteration is built to its advantage: its rasterization under autograd, as its trainer calls it, and
torch's fused Adam. For the loss it is given this project's own kernel, which its wheel has nothing to match with, so
that the ratio tells of the rest. `ratios` are its times over ours, `kernel_ratios` those of the sums of kernel times.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from gpu_kernels import (
    STEPS,
    Record,
    about,
    arguments,
    draw,
    forward_backward,
    kernel_sums,
    over_scenes,
    photograph_of,
    raw_params,
    step_kernels,
    timed,
    whole_step,
)
from gpu_scenes import GpuCase
from torch import Tensor

import cuda_ext
from cuda_ext import load
from cuda_ext.arrays import fill, new_state, stream_of
from cuda_ext.training.step_buffers import MARGIN, ResidentViews
from pop_fast.cuda import rasterization

LAMBDA_SSIM = 0.01
COMPARED = ("forward", "forward_backward", "step")


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
    rasterize: Callable[..., Any], scene: dict[str, Tensor], case: GpuCase, photograph: Tensor
) -> dict[str, Any]:
    """Time loss, optimizer and whole iteration."""
    params = {name: value.requires_grad_() for name, value in raw_params(scene).items()}
    optimizers = [torch.optim.Adam([value], lr=1e-9, eps=1e-15, fused=True) for value in params.values()]
    loss = FusedLoss(scene, photograph)

    def render() -> Tensor:
        scales, opacities = torch.exp(params["scales"]), torch.sigmoid(params["opacities"])
        sh = torch.cat((params["sh0"], params["shN"]), 1)
        leaves = {**scene, **params, "scales": scales, "opacities": opacities, "sh": sh}
        return draw(rasterize, leaves, case)[0]

    def update() -> None:
        for optimizer in optimizers:
            optimizer.step()

    def iteration() -> None:
        image = render()
        image.backward(loss.v_image(image.detach()[0].contiguous())[None])
        update()
        for optimizer in optimizers:
            optimizer.zero_grad(set_to_none=True)

    whole, kernels = timed(iteration), kernel_sums(iteration)
    image = render()
    image.backward(torch.zeros_like(image))
    fixed = image.detach()[0].contiguous()
    times = {"step_ms": whole, "optimizer_ms": timed(update), "loss_ms": timed(lambda: loss.v_image(fixed))}
    return {**times, "step_kernels": kernels}


def beside(case: GpuCase, scene: dict[str, Tensor], theirs: Callable[..., Any], record: Record) -> None:
    """Measure both sides of one case, and their ratios."""
    photograph = photograph_of(scene, case)

    def ours_measured() -> dict[str, Any]:
        found = forward_backward(rasterization, scene, case) | whole_step(scene, photograph, STEPS)
        return found | {"step_kernels": step_kernels(scene, photograph, max(STEPS // 10, 1))}

    def theirs_measured() -> dict[str, Any]:
        return forward_backward(theirs, scene, case) | gsplat_iteration(theirs, scene, case, photograph)

    ours, other = record.part("ours", ours_measured), record.part("gsplat", theirs_measured)
    if ours is None or other is None:
        return
    record.part("ratios", lambda: {name: other[f"{name}_ms"] / ours[f"{name}_ms"] for name in COMPARED})
    sums = [{name: found[f"{name}_kernels"].get("kernels_ms") for name in COMPARED} for found in (ours, other)]
    both = {name: sums[1][name] / sums[0][name] for name in COMPARED if sums[0][name] and sums[1][name]}
    record.part("kernel_ratios", lambda: both or {"skipped": "the profiler saw no kernels"})


def main() -> int:
    """Run the comparison from the command line."""
    args = arguments(__doc__)
    reason = cuda_ext.why_not()
    if reason is not None:
        print(f"gpu_gsplat: {reason}", file=sys.stderr)
        return 2
    import gsplat

    results: dict[str, Any] = {**about(), "gsplat": gsplat.__version__, "cases": {}}

    def measured(case: GpuCase, scene: dict[str, Tensor], record: Record) -> None:
        beside(case, scene, gsplat.rasterization, record)

    return over_scenes(args, results, torch.device(args.device), measured)


if __name__ == "__main__":
    sys.exit(main())
