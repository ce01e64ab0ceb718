"""The oracle behind `rasterization()`'s signature: slow, exact, float64, for small scenes and for comparison."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.api.checks import check_cameras, check_colors, check_gaussians, check_tensor, resolved_profile
from pop_fast.api.rasterize import rasterization as on_every_backend
from pop_fast.errors import PopError
from pop_ref.constants import Profile
from pop_ref.records import Camera, Gaussians, Render
from pop_ref.render import render, render_vjp


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    *,
    profile: str | Profile = "paper",
    dominance: bool = True,
    counts: bool = True,
    **others: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render harmonics, RGB, unpacked, with the oracle; see `pop_fast.api.rasterize.rasterization` for the arguments.

    `dominance` and `counts` are accepted: the oracle always finds both. `others` are the arguments of that signature
    that the oracle does not know; they must be at their defaults.

    Raises:
        TypeError: an argument is not one of that signature.
        ValueError: an input's shape, type or value is wrong.
        PopError: a mode the oracle does not offer behind this signature.
    """
    _check_offered({**others, "render_mode": render_mode, "packed": packed})
    if sh_degree is None:
        raise PopError("sh_degree=None: backend 'ref' renders harmonics only; use backend 'fast'")
    batch = check_gaussians(means, quats, scales, opacities, None)
    n_cameras = check_cameras(viewmats, Ks, width, height, tile_size, batch, means.dtype)
    per_camera = check_colors(colors, sh_degree, batch, n_cameras, means.shape[-2], means.dtype)
    if batch or per_camera:
        raise PopError("backend 'ref' takes one scene, [N, ...], and colours shared by its cameras")
    if backgrounds is None:
        backgrounds = means.new_zeros((n_cameras, 3))
    check_tensor("backgrounds", backgrounds, (n_cameras, 3), means.dtype)
    chosen = resolved_profile(profile, near_plane, far_plane, eps2d)
    settings = {
        "sh_degree": sh_degree,
        "profile": chosen,
        "tile_size": tile_size,
        "antialiased": rasterize_mode == "antialiased",
    }
    means2d = means.new_zeros((n_cameras, len(means), 2), requires_grad=torch.is_grad_enabled())
    if absgrad:
        means2d.absgrad = torch.zeros_like(means2d)  # type: ignore[attr-defined]
    images: list[Tensor] = []
    alphas: list[Tensor] = []
    renders: list[Render] = []
    scene = (means, quats, scales, opacities, colors)
    for i in range(n_cameras):
        made: list[Render] = []
        options = (Ks[i], width, height, settings, made, means2d, i)
        image, alpha = _Oracle.apply(*scene, viewmats[i], backgrounds[i], means2d, options)
        images.append(image)
        alphas.append(alpha[..., None])
        renders += made
    meta = _meta(renders, means2d, means.dtype)
    return torch.stack(images), torch.stack(alphas), {**meta, "width": width, "height": height, "tile_size": tile_size}


def _check_offered(arguments: Mapping[str, Any]) -> None:
    parameters = inspect.signature(on_every_backend).parameters
    for name, value in arguments.items():
        if name not in parameters:
            raise TypeError(f"rasterization() got an unexpected keyword argument {name!r}")
        # the oracle's meta has a row for every Gaussian; all channels are blended in one go, whatever their number
        only = False if name == "packed" else parameters[name].default
        if name != "channel_chunk" and value is not only and value != only:
            given = "a tensor" if isinstance(value, Tensor) else repr(value)
            raise PopError(f"{name}={given}: backend 'ref' offers {only!r} only; pass that, or use backend 'fast'")


def _meta(renders: list[Render], means2d: Tensor, dtype: torch.dtype) -> dict[str, Any]:
    def stacked(of: Callable[[Render], np.ndarray], kind: torch.dtype = torch.int64) -> Tensor:
        return torch.stack([torch.as_tensor(of(r), dtype=kind) for r in renders])

    with torch.no_grad():
        means2d.copy_(stacked(lambda r: r.splats.means2d, dtype))
    return {
        "batch_ids": None,
        "camera_ids": None,
        "gaussian_ids": None,
        "means2d": means2d,
        "radii": stacked(lambda r: r.splats.radii, torch.int32),
        "depths": stacked(lambda r: r.splats.depths, dtype),
        "conics": stacked(lambda r: r.splats.conics, dtype),
        "opacities": stacked(lambda r: r.splats.opacities, dtype),
        "dominant_ids": stacked(lambda r: r.dominant_ids),
        "dominant_weights": stacked(lambda r: r.dominant_weights, dtype),
        "dominant_counts": stacked(lambda r: r.dominant_counts),
        "n_contrib": stacked(lambda r: r.n_blended, torch.int32),
        "n_traversed": stacked(lambda r: r.n_traversed, torch.int32),
        "final_T": stacked(lambda r: r.T_final, dtype),
        "n_batches": 1,
        "n_cameras": len(renders),
    }


class _Oracle(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        *scene, viewmat, background, _means2d, (K, width, height, settings, made, holder, index) = inputs
        gaussians = Gaussians(*(t.detach().double().numpy() for t in scene))
        camera = Camera(viewmat.detach().double().numpy(), K.detach().double().numpy(), width, height)
        behind = background.detach().double().numpy()
        result = render(gaussians, camera, background=behind, **settings)
        made.append(result)
        ctx.repeat = (gaussians, camera, behind, settings, holder, index, scene[0].dtype)
        dtype = scene[0].dtype
        return torch.as_tensor(result.image, dtype=dtype), torch.as_tensor(1.0 - result.T_final, dtype=dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alphas: Tensor) -> tuple[Tensor | None, ...]:
        gaussians, camera, behind, settings, holder, index, dtype = ctx.repeat
        v = render_vjp(
            gaussians, camera, v_image.double().numpy(), -v_alphas.double().numpy(), background=behind, **settings
        )
        v_means2d = torch.zeros_like(holder)
        v_means2d[index] = torch.as_tensor(v.means2d, dtype=dtype)
        if hasattr(holder, "absgrad"):
            holder.absgrad[index] += torch.as_tensor(v.means2d_abs, dtype=dtype)
        parts = (v.means, v.quats, v.scales, v.opacities, v.sh, v.viewmat, v.background)
        return (*(torch.as_tensor(part, dtype=dtype) for part in parts), v_means2d, None)
