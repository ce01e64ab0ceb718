"""The raw parameters that are trained, each with its own Adam."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.activations import scales_from_log_scales
from pop_ref.settings import BETAS, EPS, LearningRates

KEYS: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")


def make_optimizers(params: Mapping[str, Parameter], lr: LearningRates, scene_scale: float) -> dict[str, Adam]:
    """Make one dense Adam a parameter , the means' rate in units of the scene."""
    rates = {**lr.by_parameter(), "means": lr.means * scene_scale}
    return {key: Adam([params[key]], lr=rates[key], betas=BETAS, eps=EPS, fused=True) for key in KEYS}


def advance_idle(optimizer: Adam, param: Tensor) -> None:
    """Advance Adam's step counter as a step with a zero gradient and zero moments would, which changes nothing else.

    With g = m = v = 0 the update is `lr * 0 / (0 + eps) = 0` and m and v stay 0; the counter has to go on because the
    bias corrections `1 - beta^step` read it.
    """
    state = optimizer.state[param]
    if not state:
        state["step"] = torch.zeros((), dtype=torch.float32)
        state["exp_avg"] = torch.zeros_like(param)
        state["exp_avg_sq"] = torch.zeros_like(param)
    state["step"] += 1


def first_non_finite(tensors: Mapping[str, Tensor]) -> tuple[str, list[int], float] | None:
    """Return the name, the index and the value of the first entry that is NaN or infinite, or None."""
    for name, tensor in tensors.items():
        # the sum is finite unless an entry is not (or it overflows): one pass that needs no mask
        if torch.isfinite(tensor.sum()):
            continue
        bad = torch.nonzero(~torch.isfinite(tensor))
        if len(bad):
            index = [int(i) for i in bad[0]]
            return name, index, float(tensor[tuple(index)])
    return None


def first_unusable(params: Mapping[str, Tensor]) -> tuple[str, list[int], float] | None:
    """Return name, index and value of the first raw parameter that cannot be rendered, or None.

    That is one which is not finite, or a scale whose exponential is not.
    """
    return first_non_finite(params) or first_non_finite({"scales": scales_from_log_scales(params["scales"])})
