"""Gaussians and a camera as tensors, and how the stages' tensors lie in memory.

Meaning, names and shapes are those of `pop_ref.records`. A tensor is component-major: it has the oracle's logical shape
[N, ...], and each component is one contiguous row of N numbers, so that every elementwise operation vectorises.
`columns` takes a tensor apart into components, and `from_columns` puts components together.

Stages use elementwise operations only, never a matrix product over the N Gaussians: a product's rounding depends on how
many columns it has, and then an invisible Gaussian would change the bits of those that are seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from itertools import product
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """Activated Gaussians of a scene; see `pop_ref.records.Gaussians`."""

    means: Tensor  # centres, world units. [N, 3]
    quats: Tensor  # rotations wxyz, any norm > 0. [N, 4]
    scales: Tensor  # standard deviations, world units. [N, 3]
    opacities: Tensor  # in [0, 1]. [N]
    sh: Tensor  # coefficients. [N, n_sh, 3]


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV's convention; see `pop_ref.records.Camera`."""

    viewmat: Tensor  # world -> camera. [4, 4]
    K: Tensor  # intrinsics, px. [3, 3]
    width: int  # px
    height: int  # px


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Make the backward pass of an autograd function refuse to be differentiated, with a RuntimeError.

    Torch's own decorator refuses only where a cotangent requires a gradient and no inputs are named: the Hessian of a
    sum was 0.
    """

    @wraps(backward)
    def once(ctx: Any, *cotangents: Any) -> Any:
        if torch.is_grad_enabled():
            raise RuntimeError("there are no second derivatives here; take gradients without create_graph=True")
        return backward(ctx, *cotangents)

    return once


def full_precision_backward(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Make the backward pass of an autograd function differentiable once, and run it in full precision.

    A loss whose backward pass is called inside `torch.autocast` would have its matrix products in half precision: the
    mode is that of the thread, whatever the forward pass ran in.
    """

    @wraps(backward)
    def exact(ctx: Any, *cotangents: Tensor | None) -> Any:
        device = next((v.device.type for v in cotangents if v is not None), "cpu")
        with torch.autocast(device, enabled=False):
            return backward(ctx, *cotangents)

    return once_differentiable(exact)


def columns(tensor: Tensor) -> tuple[Tensor, ...]:
    """Return the components of [N, ...] as tensors of [N], the last axis fastest."""
    return tuple(tensor[(slice(None), *index)] for index in product(*(range(n) for n in tensor.shape[1:])))


def from_columns(components: Sequence[Tensor], shape: tuple[int, ...]) -> Tensor:
    """Return [N, *shape] from its components ([N] each, the last axis fastest)."""
    stacked = torch.stack(tuple(components)).reshape(*shape, len(components[0]))
    return stacked.permute(stacked.dim() - 1, *range(stacked.dim() - 1))


def sum_of_products(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Return a[0] b[0] + a[1] b[1] + ... of component rows."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total
