"""Checks at the door of the CUDA `rasterization`: shapes, types, places and arguments, before a launch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from cuda_ext import arrays
from pop_ref.constants import GSPLAT_1_5, Profile, profile_named

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def resolved_profile(profile: str | Profile, near_plane: float, far_plane: float, eps2d: float) -> Profile:
    """Return the profile with the caller's planes and low-pass where they differ from gsplat's defaults."""
    chosen = profile_named(profile) if isinstance(profile, str) else profile
    given = {"near_plane": near_plane, "far_plane": far_plane, "eps2d": eps2d}
    return replace(chosen, **{name: value for name, value in given.items() if value != getattr(GSPLAT_1_5, name)})


def check_only(arguments: Mapping[str, tuple[Any, Any, str]]) -> None:
    """Raise for an argument that is not at the one value supported: name -> (value, supported, why).

    Raises:
        NotImplementedError: names the argument.
    """
    for name, (value, supported, why) in arguments.items():
        if value is not supported and value != supported:
            raise NotImplementedError(f"{name}={value!r} is not supported by backend 'cuda': {why}")


def check_tensor(name: str, tensor: Tensor | None, shape: tuple[int | None, ...]) -> Tensor:
    """Return a float32 CUDA tensor of that shape, None standing for any size.

    Raises:
        ValueError: names the tensor and what to do.
    """
    if tensor is None:
        raise ValueError(f"{name} is missing")
    if not arrays.on_gpu(tensor):
        raise ValueError(f"{name} is on {tensor.device}; backend 'cuda' needs it on the GPU: use {name}.cuda()")
    if tensor.dtype != torch.float32:
        raise ValueError(f"{name} has dtype {tensor.dtype}; backend 'cuda' computes in float32: use {name}.float()")
    fits = tensor.dim() == len(shape) and all(w is None or w == g for w, g in zip(shape, tensor.shape, strict=True))
    if not fits:
        want = "[" + ", ".join("any" if size is None else str(size) for size in shape) + "]"
        raise ValueError(f"{name} has shape {list(tensor.shape)}; it must be {want}")
    return tensor


def check_scene(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
    opacities: Tensor,
    colors: Tensor,
    sh_degree: int | None,
    n_cameras: int,
) -> bool:
    """Check one scene's tensors and tell whether colours are given per camera.

    Raises:
        ValueError: names the tensor.
        NotImplementedError: more than one scene.
    """
    if means.dim() > 2:
        raise NotImplementedError("batch dimensions are not supported by backend 'cuda': call it once a scene")
    n = check_tensor("means", means, (None, 3)).shape[0]
    check_tensor("quats", quats, (n, 4))
    check_tensor("scales", scales, (n, 3))
    check_tensor("opacities", opacities, (n,))
    if sh_degree is None:
        per_camera = colors.dim() == 3
        check_tensor("colors", colors, (n_cameras, n, None) if per_camera else (n, None))
        return per_camera
    if sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree is {sh_degree}; it must be None, 0, 1, 2 or 3")
    per_camera = colors.dim() == 4
    check_tensor("colors", colors, (n_cameras, n, None, 3) if per_camera else (n, None, 3))
    if colors.shape[-2] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors has {colors.shape[-2]} coefficients; sh_degree={sh_degree} needs {(sh_degree + 1) ** 2}"
        )
    return per_camera


def check_values(scene: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor) -> None:
    """Check values; a few reductions on the GPU and one synchronisation.

    Args:
        scene: means, quats, scales, opacities and colors.
        viewmats: [C, 4, 4]
        Ks: [C, 3, 3]

    Raises:
        ValueError: names the tensor and the index.
    """
    rules = [*_scene_rules(**scene), *_camera_rules(viewmats.detach(), Ks.detach())]
    found = torch.stack([rule.suspicious() for rule in rules]).tolist()
    for wrong, rule in zip(found, rules, strict=True):
        bad = rule.bad().nonzero() if wrong else None
        if bad is not None and len(bad):
            index = bad[0].tolist()
            raise ValueError(f"{rule.name}{index} is {rule.tensor.detach()[tuple(index)].tolist()}; it {rule.words}")


@dataclass(frozen=True)
class _Rule:
    """A tensor, which of its entries or rows are bad, and what it must be; `quick` asks whether any may be."""

    name: str
    tensor: Tensor
    bad: Callable[[], Tensor]
    words: str
    quick: Callable[[], Tensor] | None = None

    def suspicious(self) -> Tensor:
        return self.bad().any() if self.quick is None else self.quick()


def _scene_rules(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor) -> list[_Rule]:
    def no_rotation() -> Tensor:
        return ~(quats.abs().sum(1) > 0.0) | ~torch.isfinite(quats).all(1)

    # a sum is one pass without a mask of colours' size, and only a suspicious one is looked at closely
    quick = partial(_sum_is_not_finite, colors.detach())
    return [
        _Rule("means", means, lambda: ~torch.isfinite(means), "must be finite"),
        _Rule("quats", quats, no_rotation, "must be finite, with a norm > 0"),
        _Rule(
            "scales", scales, lambda: ~(scales >= 0.0) | torch.isinf(scales), "must be >= 0 and finite; not logarithms"
        ),
        _Rule("opacities", opacities, lambda: ~((opacities >= 0.0) & (opacities <= 1.0)), "must be in [0, 1]"),
        _Rule("colors", colors, lambda: ~torch.isfinite(colors), "must be finite", quick),
    ]


def _camera_rules(viewmats: Tensor, Ks: Tensor) -> list[_Rule]:
    R = viewmats[:, :3, :3]

    def not_rigid() -> Tensor:
        # products of rows: no matrix library, which torch's deterministic mode would have an opinion on
        products = (R[:, :, None, :] * R[:, None, :, :]).sum(-1)
        off = (products - torch.eye(3, device=R.device)).abs().amax((-1, -2))
        right_handed = (torch.linalg.cross(R[:, 0], R[:, 1]) * R[:, 2]).sum(-1) > 0.0
        return ~((off < 1e-3) & right_handed & torch.isfinite(viewmats).all(-1).all(-1))

    def not_last() -> Tensor:
        return (viewmats[:, 3] != torch.tensor([0.0, 0.0, 0.0, 1.0], device=R.device)).any(-1)

    def not_pinhole() -> Tensor:
        skew = (Ks[:, 0, 1] != 0.0) | (Ks[:, 1, 0] != 0.0) | (Ks[:, 2, :2] != 0.0).any(-1) | (Ks[:, 2, 2] != 1.0)
        return skew | ~(Ks[:, 0, 0] > 0.0) | ~(Ks[:, 1, 1] > 0.0) | ~torch.isfinite(Ks).all(-1).all(-1)

    pinhole = "must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with finite fx, fy > 0; skew is not supported"
    return [
        _Rule("viewmats", viewmats, not_rigid, "must be rigid: an orthonormal 3x3 rotation with determinant +1"),
        _Rule("viewmats", viewmats, not_last, "must end in the row [0, 0, 0, 1]"),
        _Rule("Ks", Ks, not_pinhole, pinhole),
    ]


def _sum_is_not_finite(tensor: Tensor) -> Tensor:
    return ~torch.isfinite(tensor.sum())
