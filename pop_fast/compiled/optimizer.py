"""Adam as the native step runs it, float32. Meaning: `pop_ref.optimizer`.

A training calls it inside the step (`step_update.cpp`); here it can be called by itself, so that laws judge it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pop_fast.compiled.library import this_library
from pop_ref.settings import BETAS, EPS

Moved = tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Tensor]]


def adam_step(
    params: Mapping[str, Tensor],
    grads: Mapping[str, Tensor],
    m: Mapping[str, Tensor],
    v: Mapping[str, Tensor],
    step: int,
    lr: Mapping[str, float],
) -> Moved:
    """See `pop_ref.optimizer.adam_step`; betas and eps are those of a training."""
    x, first, second = ({key: value.clone().contiguous() for key, value in group.items()} for group in (params, m, v))
    for key in grads:
        _move(x[key], first[key], second[key], grads[key].contiguous(), step, lr[key])
    return x, first, second


def adam_steps(params: Mapping[str, Tensor], grads: Sequence[Mapping[str, Tensor]], lr: Mapping[str, float]) -> Moved:
    """See `pop_ref.optimizer.adam_steps`: what waits is not touched, and the counter is that of the steps."""
    x = {key: value.clone().contiguous() for key, value in params.items()}
    m, v = ({key: torch.zeros_like(value) for key, value in x.items()} for _ in range(2))
    for step, given in enumerate(grads, 1):
        for key, gradient in given.items():
            _move(x[key], m[key], v[key], gradient.contiguous(), step, lr[key])
    return x, m, v


def _move(x: Tensor, m: Tensor, v: Tensor, gradient: Tensor, step: int, lr: float) -> None:
    arrays = (tensor.data_ptr() for tensor in (x, m, v, gradient))
    this_library().adam(*arrays, x.numel(), step, lr, *BETAS, EPS)
