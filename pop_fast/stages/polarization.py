"""The polarized opacity prior. Meaning: `pop_ref.polarization`."""

from __future__ import annotations

import torch
from torch import Tensor


def importance_mask(dominant_counts: Tensor) -> Tensor:
    """See `pop_ref.polarization.importance_mask`. Works for [N] and, view by view, for [C, N].

    Optimizations: none.
    """
    return dominant_counts > 0


def pop_loss(opacities: Tensor, mask: Tensor, visible: Tensor | None = None) -> Tensor:
    """See `pop_ref.polarization.pop_loss`; differentiable in `opacities`, the mask is a constant.

    Optimizations: the gradient does not depend on the opacities, so it is made with the value and backward is one
    product; no data-dependent shapes, so nothing waits for a device.
    """
    if not (opacities.requires_grad and torch.is_grad_enabled()):
        return _value_and_grad(opacities, mask, visible)[0]
    return _PopLoss.apply(opacities, mask, visible)


def pop_loss_vjp(opacities: Tensor, mask: Tensor, v_loss: Tensor | float, visible: Tensor | None = None) -> Tensor:
    """See `pop_ref.polarization.pop_loss_vjp`.

    Optimizations: none.
    """
    return v_loss * _value_and_grad(opacities, mask, visible)[1]


def opacity_entropy(logits: Tensor) -> Tensor:
    """See `pop_ref.polarization.opacity_entropy`; differentiable in `logits`.

    Optimizations: none.
    """
    return _Entropy.apply(logits)


def opacity_entropy_vjp(logits: Tensor, v_loss: Tensor | float) -> Tensor:
    """See `pop_ref.polarization.opacity_entropy_vjp`.

    Optimizations: none.
    """
    o = torch.sigmoid(logits)
    return -v_loss * logits * o * torch.sigmoid(-logits) / max(len(logits), 1)


class _Entropy(torch.autograd.Function):
    @staticmethod
    def forward(ctx, logits: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(logits)
        softplus = torch.nn.functional.softplus
        entropies = torch.sigmoid(logits) * softplus(-logits) + torch.sigmoid(-logits) * softplus(logits)
        return entropies.sum() / max(len(logits), 1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, v_loss: Tensor) -> Tensor:  # type: ignore[override]
        return opacity_entropy_vjp(ctx.saved_tensors[0], v_loss)


def _value_and_grad(opacities: Tensor, mask: Tensor, visible: Tensor | None) -> tuple[Tensor, Tensor]:
    other = ~mask
    if visible is not None:
        mask, other = mask & visible, other & visible
    pull_up = mask.to(opacities.dtype) / mask.sum().clamp_min(1)
    push_down = other.to(opacities.dtype) / other.sum().clamp_min(1)
    # (1 - o) is formed before it is weighed, so that polarised opacities give exactly 0
    value = torch.dot(1.0 - opacities, pull_up) + torch.dot(opacities, push_down)
    return value, push_down - pull_up


class _PopLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, opacities: Tensor, mask: Tensor, visible: Tensor | None) -> Tensor:  # type: ignore[override]
        value, grad = _value_and_grad(opacities, mask, visible)
        ctx.save_for_backward(grad)
        return value

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, v_loss: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return v_loss * grad, None, None
