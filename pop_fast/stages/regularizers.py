"""Terms of the loss next to the photographs: the polarized opacity prior, and those for captures of few photographs.

Meaning: `pop_ref.polarization`, `pop_ref.regularizers`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.stages.types import Camera


def depth_samples(points: Tensor, camera: Camera, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """See `pop_ref.regularizers.depth_samples`; points [P, 3], mask bool [H, W] or None.

    Optimizations: all points at once.
    """
    in_camera = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    in_camera = in_camera[in_camera[:, 2] > 0.0]
    depths = in_camera[:, 2]
    places = (in_camera / depths[:, None]) @ camera.K[:2].T
    shown = (places >= 0.0).all(1) & (places[:, 0] < camera.width) & (places[:, 1] < camera.height)
    if mask is not None:
        column, row = places.nan_to_num().long().unbind(1)
        shown &= mask[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return places[shown], 1.0 / depths[shown]


def sparse_depth_loss(depth: Tensor, places: Tensor, disparities: Tensor) -> Tensor:
    """See `pop_ref.regularizers.sparse_depth_loss`; differentiable in `depth` [H, W], by torch's own graph.

    Optimizations: all samples at once.
    """
    height, width = depth.shape
    u, v = (places[:, 0] - 0.5).clamp(0.0, width - 1.0), (places[:, 1] - 0.5).clamp(0.0, height - 1.0)
    left, top = u.long(), v.long()
    right, bottom = (left + 1).clamp_max(width - 1), (top + 1).clamp_max(height - 1)
    a, b = u - left, v - top
    above = (1.0 - a) * depth[top, left] + a * depth[top, right]
    below = (1.0 - a) * depth[bottom, left] + a * depth[bottom, right]
    sampled = (1.0 - b) * above + b * below
    seen = sampled > 0.0
    # what is divided is never 0, so that no gradient is a product of 0 and infinity
    rendered = torch.where(seen, 1.0 / torch.where(seen, sampled, 1.0), 0.0)
    return (rendered - disparities).abs().sum() / max(len(disparities), 1)


def mean_activation(values: Tensor) -> Tensor:
    """See `pop_ref.regularizers.mean_activation`; differentiable in `values`."""
    return values.sum() / max(values.numel(), 1)


def importance_mask(dominant_counts: Tensor) -> Tensor:
    """See `pop_ref.polarization.importance_mask`. Works for [N] and, view by view, for [C, N]."""
    return dominant_counts > 0


def pop_loss(opacities: Tensor, mask: Tensor, visible: Tensor | None = None) -> Tensor:
    """See `pop_ref.polarization.pop_loss`; differentiable in `opacities`, the mask is a constant.

    Optimizations: the gradient does not depend on the opacities, so it is made with the value and backward is one
    product; no data-dependent shapes, so nothing waits for a device.

    Raises:
        ValueError: the mask is not bool, as counts are not, or not of these opacities.
    """
    if not (opacities.requires_grad and torch.is_grad_enabled()):
        return _value_and_grad(opacities, mask, visible)[0]
    return _PopLoss.apply(opacities, mask, visible)


def pop_loss_vjp(opacities: Tensor, mask: Tensor, v_loss: Tensor | float, visible: Tensor | None = None) -> Tensor:
    """See `pop_ref.polarization.pop_loss_vjp`."""
    return v_loss * _value_and_grad(opacities, mask, visible)[1]


def opacity_entropy(logits: Tensor) -> Tensor:
    """See `pop_ref.polarization.opacity_entropy`; differentiable in `logits`."""
    return _Entropy.apply(logits)


def opacity_entropy_vjp(logits: Tensor, v_loss: Tensor | float) -> Tensor:
    """See `pop_ref.polarization.opacity_entropy_vjp`."""
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
    def backward(ctx, v_loss: Tensor) -> Tensor:  # type: ignore[override]
        return opacity_entropy_vjp(ctx.saved_tensors[0], v_loss)


def _value_and_grad(opacities: Tensor, mask: Tensor, visible: Tensor | None) -> tuple[Tensor, Tensor]:
    if mask.dtype != torch.bool or mask.shape != opacities.shape:
        raise ValueError(
            f"mask is {mask.dtype} {list(mask.shape)}; it must be torch.bool {list(opacities.shape)}, "
            "as importance_mask makes it of dominant counts"
        )
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
    def backward(ctx, v_loss: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return v_loss * grad, None, None
