"""Raw parameters -> scales, opacities, unit quaternions. Meaning: `pop_ref.activations`."""

from __future__ import annotations

import torch
from torch import Tensor


def scales_from_log_scales(log_scales: Tensor) -> Tensor:
    """See `pop_ref.activations.scales_from_log_scales`. Optimizations: none."""
    return torch.exp(log_scales)


def scales_from_log_scales_vjp(log_scales: Tensor, v_scales: Tensor) -> Tensor:
    """See `pop_ref.activations.scales_from_log_scales_vjp`. Optimizations: none."""
    return torch.exp(log_scales) * v_scales


def opacities_from_logits(logit_opacities: Tensor) -> Tensor:
    """See `pop_ref.activations.opacities_from_logits`. Optimizations: none."""
    return torch.sigmoid(logit_opacities)


def opacities_from_logits_vjp(logit_opacities: Tensor, v_opacities: Tensor) -> Tensor:
    """See `pop_ref.activations.opacities_from_logits_vjp`. Optimizations: none."""
    opacities = torch.sigmoid(logit_opacities)
    return opacities * (1.0 - opacities) * v_opacities


def unit_quats_from_quats(quats: Tensor) -> Tensor:
    """See `pop_ref.activations.unit_quats_from_quats`. Optimizations: none."""
    return quats / quats.norm(dim=-1, keepdim=True)


def unit_quats_from_quats_vjp(quats: Tensor, v_unit_quats: Tensor) -> Tensor:
    """See `pop_ref.activations.unit_quats_from_quats_vjp`. Optimizations: none."""
    norms = quats.norm(dim=-1, keepdim=True)
    unit = quats / norms
    return (v_unit_quats - unit * (unit * v_unit_quats).sum(-1, keepdim=True)) / norms
