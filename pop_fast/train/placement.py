"""On which device the rows of a run lie: its engine's while it trains, the CPU in a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.density.protocol import State
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.model import KEYS, make_optimizers


def moved_to(
    device: torch.device, params: Mapping[str, Parameter], optimizers: Mapping[str, Adam], state: State
) -> tuple[dict[str, Parameter], dict[str, Adam]]:
    """Return parameters and their optimizers on a device; the statistics in `state` are replaced by theirs there."""
    moments = ckpt.pack_optimizers(optimizers)
    placed = {key: Parameter(params[key].detach().to(device)) for key in KEYS}
    made = make_optimizers(placed)
    for key, found in moments.items():
        there = {name: value if name == "step" else value.to(device) for name, value in found.items()}
        made[key].state[placed[key]] = there
    for key, value in state.items():
        state[key] = value.to(device) if isinstance(value, Tensor) else value
    return placed, made


def on_cpu(content: Any) -> Any:
    """Return nested dicts with their tensors on the CPU; those that are there already are not copied."""
    if isinstance(content, Mapping):
        return {key: on_cpu(value) for key, value in content.items()}
    return content.cpu() if isinstance(content, Tensor) else content
