"""Checks at the door of `rasterization`: every wrong input is named, with its index, before anything is computed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from pop_ref.constants import GSPLAT_1_5, Profile, profile_named

LARGEST_TILE = 4096  # px; no image needs more, and what a tile works with grows with its square
RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def resolved_profile(profile: str | Profile, near_plane: float, far_plane: float, eps2d: float) -> Profile:
    """Return the profile with the caller's near plane, far plane and low-pass where they differ from gsplat's."""
    chosen = profile_named(profile) if isinstance(profile, str) else profile
    given = {"near_plane": near_plane, "far_plane": far_plane, "eps2d": eps2d}
    changed = {name: value for name, value in given.items() if value != getattr(GSPLAT_1_5, name)}
    return replace(chosen, **changed) if changed else chosen


def check_supported(arguments: Mapping[str, tuple[Any, Any, str]]) -> None:
    """Raise for any argument that is not at the one value supported here.

    Args:
        arguments: name -> (value, supported value, why).

    Raises:
        NotImplementedError: names the argument.
    """
    for name, (value, supported, why) in arguments.items():
        if value is not supported and value != supported:
            raise NotImplementedError(f"{name}={value!r} is not supported: {why}")


def check_gaussians(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    covars: Tensor | None,
) -> tuple[int, ...]:
    """Check the Gaussians' shapes, types and values, and return the batch dimensions.

    Raises:
        ValueError: names the tensor and the index.
    """
    if means.dim() < 2 or means.shape[-1] != 3:
        raise ValueError(f"means has shape {list(means.shape)}; it must be [..., N, 3]")
    batch, n = tuple(means.shape[:-2]), means.shape[-2]
    shapes: dict[str, tuple[Tensor | None, tuple[int, ...]]] = {"opacities": (opacities, (*batch, n))}
    if covars is None:
        shapes |= {"quats": (quats, (*batch, n, 4)), "scales": (scales, (*batch, n, 3))}
    else:
        shapes["covars"] = (covars, (*batch, n, 3, 3))
    check_tensor("means", means, tuple(means.shape), means.dtype)
    for name, (tensor, shape) in shapes.items():
        check_tensor(name, tensor, shape, means.dtype)
    if n == 0:
        return batch
    _reject("opacities", opacities, (opacities < 0.0) | (opacities > 1.0), "must be in [0, 1]")
    if covars is None:
        assert quats is not None
        assert scales is not None
        if bool(scales.amin() < 0.0):
            _reject("scales", scales, scales < 0.0, "must be >= 0; give standard deviations, not logarithms")
        if bool(quats.abs().amax(-1).amin() == 0.0):
            _reject("quats", quats, (quats == 0.0).all(-1), "must have a norm > 0")
    return batch


def check_cameras(
    viewmats: Tensor, Ks: Tensor, width: int, height: int, tile_size: int, batch: tuple[int, ...], dtype: torch.dtype
) -> int:
    """Check the cameras and return how many there are.

    Raises:
        ValueError: names the tensor and the index.
    """
    if viewmats.dim() < 3:
        raise ValueError(f"viewmats has shape {list(viewmats.shape)}; it must be [..., C, 4, 4]")
    n = viewmats.shape[-3]
    check_tensor("viewmats", viewmats, (*batch, n, 4, 4), dtype)
    check_tensor("Ks", Ks, (*batch, n, 3, 3), dtype)
    for name, value in {"width": width, "height": height, "tile_size": tile_size}.items():
        if value < 1:
            raise ValueError(f"{name} is {value}; it must be >= 1")
    if tile_size > LARGEST_TILE:
        raise ValueError(f"tile_size is {tile_size}; it must be <= {LARGEST_TILE}")
    rotations = viewmats.detach()[..., :3, :3].double()
    off = (rotations @ rotations.transpose(-1, -2) - torch.eye(3, dtype=torch.float64)).abs().amax((-1, -2))
    rigid = (off < 1e-3) & (torch.linalg.det(rotations) > 0.0)
    _reject("viewmats", viewmats, ~rigid, "must be rigid: an orthonormal 3x3 rotation with determinant +1")
    last = (viewmats.detach()[..., 3, :] - torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=dtype)).abs().amax(-1)
    _reject("viewmats", viewmats, last > 0.0, "must end in the row [0, 0, 0, 1]")
    _reject("Ks", Ks, (Ks[..., 0, 0] <= 0.0) | (Ks[..., 1, 1] <= 0.0), "must have focal lengths > 0")
    skew = (Ks[..., 0, 1] != 0.0) | (Ks[..., 1, 0] != 0.0) | (Ks[..., 2, :2] != 0.0).any(-1) | (Ks[..., 2, 2] != 1.0)
    _reject("Ks", Ks, skew, "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return n


def check_colors(
    colors: Tensor, sh_degree: int | None, batch: tuple[int, ...], n_cameras: int, n: int, dtype: torch.dtype
) -> bool:
    """Check the colours or coefficients, and tell whether they are given per camera.

    Raises:
        ValueError: names the tensor and the index.
    """
    tail = 1 if sh_degree is None else 2
    channels = tuple(colors.shape[colors.dim() - tail :])
    shared, per_camera = (*batch, n, *channels), (*batch, n_cameras, n, *channels)
    if sh_degree is not None:
        if sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree is {sh_degree}; it must be None, 0, 1, 2 or 3")
        if len(channels) != 2 or channels[1] != 3 or channels[0] < (sh_degree + 1) ** 2:
            need = (sh_degree + 1) ** 2
            raise ValueError(
                f"colors has shape {list(colors.shape)}; sh_degree={sh_degree} needs [..., N, >={need}, 3]"
            )
    check_tensor("colors", colors, per_camera if tuple(colors.shape) == per_camera else shared, dtype)
    return tuple(colors.shape) == per_camera


def check_tensor(name: str, tensor: Tensor | None, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Check one tensor's presence, type, shape and finiteness.

    Raises:
        ValueError: names the tensor and the index.
    """
    if tensor is None:
        raise ValueError(f"{name} is missing")
    if tensor.device.type != "cpu":
        raise ValueError(f"{name} is on {tensor.device}; this backend runs on the CPU: use {name}.cpu()")
    if tensor.dtype not in (torch.float32, torch.float64) or tensor.dtype != dtype:
        raise ValueError(f"{name} has dtype {tensor.dtype}; all tensors must be float32, or all float64")
    if tuple(tensor.shape) != shape:
        raise ValueError(f"{name} has shape {list(tensor.shape)}; it must be {list(shape)}")
    # a sum is one fast pass, and only a suspicious one is looked at closely
    if not bool(torch.isfinite(tensor.detach().sum())):
        _reject(name, tensor, ~torch.isfinite(tensor), "must be finite")


def _reject(name: str, tensor: Tensor, bad: Tensor, rule: str) -> None:
    if bool(bad.any()):
        index = bad.nonzero()[0].tolist()
        raise ValueError(f"{name}{index} is {tensor.detach()[tuple(index)].tolist()}; it {rule}")
