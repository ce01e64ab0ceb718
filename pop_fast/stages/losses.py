"""L1, L2 and the photometric objectives. Meaning, masks included: `pop_ref.losses`.

Every loss is one autograd node that makes its gradient together with its value: losses are scalars, so backward is one
product, and what is kept for it is one image. `moments=target_moments(target)` spares the part of SSIM that depends on
the photograph alone; `dissimilarity` is what computes SSIM, by default `pop_fast.stages.ssim.mean_dissimilarity`.
Derivatives are taken by the render only; a target that requires a gradient is refused.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import torch
from torch import Tensor

from pop_fast.stages.ssim import Padding, TargetMoments, check_size, mean_dissimilarity, ssim_map, target_moments
from pop_ref.settings import LAMBDA_SSIM_3DGS, Objective, Recipe

__all__ = ["L1", "L2", "Loss", "Padding", "TargetMoments", "target_moments", "ssim_map", "l1", "l1_vjp", "l2", "l2_vjp"]
__all__ += ["ssim", "ssim_vjp", "d_ssim", "d_ssim_vjp"]
__all__ += ["photometric", "photometric_3dgs", "photometric_3dgs_vjp", "photometric_pop", "photometric_pop_vjp"]

Dissimilarity = Callable[..., tuple[Tensor, Tensor | None]]


@dataclass(frozen=True)
class Loss:
    """What the pixels of a render are compared with their photograph by, as `pop_fast.train.presets.LOSSES` names it.

    Attributes:
        name: in the settings of a run, and in its records.
        pixelwise: given render and photograph [H, W, 3] and a mask [H, W] or None, a differentiable mean over the
            values that the mask keeps.
        whole: the name, in a backend's losses, of what weighs it against D-SSIM in one pass; None where the two are
            added up.
    """

    name: str
    pixelwise: Callable[[Tensor, Tensor, Tensor | None], Tensor]
    whole: str | None = None


class _Terms(NamedTuple):
    """`pixel_weight * (l1 or l2) + d_ssim_weight * (1 - ssim) + constant`; a weight of None leaves the term out."""

    pixel: Literal["l1", "l2"] = "l2"
    pixel_weight: float | None = None
    d_ssim_weight: float | None = None
    constant: float = 0.0
    dissimilarity: Dissimilarity = mean_dissimilarity


_SSIM = _Terms(d_ssim_weight=-1.0, constant=1.0)


def l1(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l1`; the derivative at equality is 0 (B4)."""
    return _loss(image, target, _Terms("l1", 1.0), "same", mask, None)


def l1_vjp(image: Tensor, target: Tensor, v_l1: Tensor | float, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l1_vjp`."""
    return v_l1 * _gradient(image, target, _Terms("l1", 1.0), "same", mask, None)


def l2(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l2`."""
    return _loss(image, target, _Terms("l2", 1.0), "same", mask, None)


def l2_vjp(image: Tensor, target: Tensor, v_l2: Tensor | float, mask: Tensor | None = None) -> Tensor:
    """See `pop_ref.losses.l2_vjp`."""
    return v_l2 * _gradient(image, target, _Terms("l2", 1.0), "same", mask, None)


def ssim(
    image: Tensor,
    target: Tensor,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.ssim.ssim`.

    Optimizations: see `pop_fast.stages.ssim`; `moments` of the target may be passed.
    """
    return _loss(image, target, _SSIM._replace(dissimilarity=dissimilarity), padding, mask, moments)


def ssim_vjp(
    image: Tensor,
    target: Tensor,
    v_ssim: Tensor | float,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    moments: TargetMoments | None = None,
) -> Tensor:
    """See `pop_ref.ssim.ssim_vjp`."""
    return v_ssim * _gradient(image, target, _SSIM, padding, mask, moments)


def d_ssim(
    image: Tensor,
    target: Tensor,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.ssim.d_ssim`."""
    terms = _Terms(d_ssim_weight=0.5 if halved else 1.0, dissimilarity=dissimilarity)
    return _loss(image, target, terms, padding, mask, moments)


def d_ssim_vjp(
    image: Tensor,
    target: Tensor,
    v_d_ssim: Tensor | float,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    moments: TargetMoments | None = None,
) -> Tensor:
    """See `pop_ref.ssim.d_ssim_vjp`."""
    return v_d_ssim * _gradient(image, target, _Terms(d_ssim_weight=0.5 if halved else 1.0), padding, mask, moments)


def photometric_3dgs(
    image: Tensor,
    target: Tensor,
    lambda_ssim: float = LAMBDA_SSIM_3DGS,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l1_scale: float = 1.0,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.losses.photometric_3dgs`.

    Optimizations: both terms and their gradients in one autograd node.
    """
    weights = ((1.0 - lambda_ssim) * l1_scale, lambda_ssim * (0.5 if halved else 1.0))
    terms = _Terms("l1", *weights, dissimilarity=dissimilarity)
    return _loss(image, target, terms, padding, mask, moments)


def photometric_3dgs_vjp(
    image: Tensor,
    target: Tensor,
    v_loss: Tensor | float,
    lambda_ssim: float = LAMBDA_SSIM_3DGS,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l1_scale: float = 1.0,
    moments: TargetMoments | None = None,
) -> Tensor:
    """See `pop_ref.losses.photometric_3dgs_vjp`."""
    terms = _Terms("l1", (1.0 - lambda_ssim) * l1_scale, lambda_ssim * (0.5 if halved else 1.0))
    return v_loss * _gradient(image, target, terms, padding, mask, moments)


def photometric_pop(
    image: Tensor,
    target: Tensor,
    lambda_ssim: float = Recipe.lambda_ssim,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l2_scale: float = 1.0,
    moments: TargetMoments | None = None,
    *,
    dissimilarity: Dissimilarity = mean_dissimilarity,
) -> Tensor:
    """See `pop_ref.losses.photometric_pop`.

    Optimizations: both terms and their gradients in one autograd node.
    """
    weights = ((1.0 - lambda_ssim) * l2_scale, lambda_ssim * (0.5 if halved else 1.0))
    terms = _Terms("l2", *weights, dissimilarity=dissimilarity)
    return _loss(image, target, terms, padding, mask, moments)


def photometric_pop_vjp(
    image: Tensor,
    target: Tensor,
    v_loss: Tensor | float,
    lambda_ssim: float = Recipe.lambda_ssim,
    padding: Padding = "valid",
    mask: Tensor | None = None,
    halved: bool = False,
    l2_scale: float = 1.0,
    moments: TargetMoments | None = None,
) -> Tensor:
    """See `pop_ref.losses.photometric_pop_vjp`."""
    terms = _Terms("l2", (1.0 - lambda_ssim) * l2_scale, lambda_ssim * (0.5 if halved else 1.0))
    return v_loss * _gradient(image, target, terms, padding, mask, moments)


L1: Final = Loss("l1", l1, "photometric_3dgs")
L2: Final = Loss("l2", l2, "photometric_pop")


def photometric(
    loss: Loss,
    objective: Objective,
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    moments: TargetMoments | None = None,
    losses: Any = None,
) -> Tensor:
    """Weigh a loss between pixels against D-SSIM, in one pass where the losses have one for it.

    Args:
        loss: that of the objective's name.
        objective: the weights.
        image: the render. [H, W, 3]
        target: the photograph. [H, W, 3]
        mask: True where a pixel counts. [H, W]
        moments: `target_moments(target)`, where they are at hand.
        losses: a backend's, with the functions of this module; None takes this module's.
    """
    of = sys.modules[__name__] if losses is None else losses
    if loss.whole is not None:
        options = (objective.lambda_ssim, objective.padding, mask, objective.d_ssim_halved, objective.pixel_scale)
        return getattr(of, loss.whole)(image, target, *options, moments=moments)
    pixel_weight, ssim_weight = objective.weights
    d_ssim = of.d_ssim(image, target, objective.padding, mask, False, moments)
    return pixel_weight * loss.pixelwise(image, target, mask) + ssim_weight * d_ssim


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, *rest: Any) -> Tensor:  # type: ignore[override]
        value, grad = _value_and_gradient(image, *rest, want_grad=True)
        ctx.save_for_backward(grad)
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_loss: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return v_loss * grad, None, None, None, None, None


def _loss(
    image: Tensor, target: Tensor, terms: _Terms, padding: Padding, mask: Tensor | None, moments: TargetMoments | None
) -> Tensor:
    if image.requires_grad and torch.is_grad_enabled():
        return _Loss.apply(image, target, terms, padding, mask, moments)
    return _value_and_gradient(image, target, terms, padding, mask, moments, want_grad=False)[0]


def _gradient(*arguments: Any) -> Tensor:
    grad = _value_and_gradient(*arguments, want_grad=True)[1]
    assert grad is not None
    return grad


@torch.no_grad()
def _value_and_gradient(
    image: Tensor,
    target: Tensor,
    terms: _Terms,
    padding: Padding,
    mask: Tensor | None,
    moments: TargetMoments | None,
    want_grad: bool,
) -> tuple[Tensor, Tensor | None]:
    _check(image, target, padding, mask, moments)
    target = target.to(image.dtype)
    difference = image - target
    if mask is not None:
        difference.masked_fill_(~mask[:, :, None], 0.0)
    value, grad = image.new_full((), terms.constant), None
    if terms.d_ssim_weight is not None:
        if moments is None:
            moments = target_moments(target, padding)
        weight = terms.d_ssim_weight if want_grad else None
        dissimilarity, grad = terms.dissimilarity(difference, moments, mask, weight)
        value = value + terms.d_ssim_weight * dissimilarity
    if terms.pixel_weight is not None:
        n = image.numel() if mask is None else max(int(mask.sum()), 1) * image.shape[2]
        total = torch.sum(difference.abs() if terms.pixel == "l1" else difference * difference)
        value = value + (terms.pixel_weight / n) * total
        if want_grad:
            slope = difference.sign_() if terms.pixel == "l1" else difference.mul_(2.0)
            grad = (
                slope.mul_(terms.pixel_weight / n) if grad is None else grad.add_(slope, alpha=terms.pixel_weight / n)
            )
    if grad is not None and mask is not None:
        grad.masked_fill_(~mask[:, :, None], 0.0)
    return value, grad


def _check(image: Tensor, target: Tensor, padding: Padding, mask: Tensor | None, moments: TargetMoments | None) -> None:
    if image.shape != target.shape:
        raise ValueError(f"image is {list(image.shape)} but target is {list(target.shape)}; they must be equal")
    if image.dim() != 3:
        raise ValueError(f"image is {list(image.shape)}; it must be [H, W, D], one view")
    if target.requires_grad:
        raise ValueError("target requires a gradient, but losses differentiate the image only; pass target.detach()")
    if mask is not None and (mask.shape != image.shape[:2] or mask.dtype != torch.bool):
        raise ValueError(f"mask is {mask.dtype} {list(mask.shape)}; it must be bool {list(image.shape[:2])}")
    check_size(image, padding)
    if moments is not None and (
        moments.padding != padding or moments.target.shape != image.shape or moments.target.dtype != image.dtype
    ):
        raise ValueError(
            "moments are of another image, padding or dtype; make them with target_moments(target, padding)"
        )
