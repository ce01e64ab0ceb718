"""Component-major tensors: the logical shape of the oracle over memory in which each component is one contiguous row.

Stage functions work on components ([N] each), so every elementwise operation runs over contiguous memory and
vectorises. `columns` takes a tensor apart, `from_columns` puts components together; the latter's result has the logical
shape [N, ...] but strides that keep each component contiguous for the next stage.


Stages use elementwise operations only, never a matrix product over the N Gaussians: a product's rounding depends on how
many columns it has, and then a Gaussian that nobody sees would change the bits of those that are seen.
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


def sum_of_products(a: Sequence[Tensor], b: Sequence[Tensor]) -> Tensor:
    """Return a[0] b[0] + a[1] b[1] + ... of component rows."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total
