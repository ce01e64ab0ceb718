"""Component-major tensors: the logical shape of the oracle over memory in which each component is one contiguous row.

Stage functions work on components ([N] each), so every elementwise operation runs over contiguous memory and
vectorises. `columns` takes a tensor apart, `from_columns` puts components together; the latter's result has the logical
shape [N, ...] but strides that keep each component contiguous for the next stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor


def columns(tensor: Tensor) -> tuple[Tensor, ...]:
    """Return the components of [N, ...] as tensors of [N], the last axis fastest."""
    return tuple(tensor[(slice(None), *index)] for index in product(*(range(n) for n in tensor.shape[1:])))


def from_columns(components: Sequence[Tensor], shape: tuple[int, ...]) -> Tensor:
    """Return [N, *shape] from its components ([N] each, the last axis fastest)."""
    stacked = torch.stack(tuple(components)).reshape(*shape, len(components[0]))
    return stacked.permute(stacked.dim() - 1, *range(stacked.dim() - 1))
