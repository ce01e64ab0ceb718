"""Reusable buffers: fresh pages cost more than the arithmetic that fills them."""

from __future__ import annotations

import torch
from torch import Tensor

RETAINED_BYTES = 1 << 30
_free: dict[tuple[torch.dtype, int], list[Tensor]] = {}


def take(numel: int, dtype: torch.dtype) -> Tensor:
    """Return a flat buffer of at least `numel` uninitialised numbers, used before if one is free.

    Lengths are powers of two, so that scenes whose sizes change from step to step go on sharing a few kinds of buffers.
    """
    length = 1 << max(numel - 1, 0).bit_length()
    slabs = _free.get((dtype, length))
    return slabs.pop() if slabs else torch.empty(length, dtype=dtype)


def give(slab: Tensor) -> None:
    """Return a buffer from `take`; nobody may use it afterwards."""
    retained = sum(length * dtype.itemsize * len(slabs) for (dtype, length), slabs in _free.items())
    if retained + slab.numel() * slab.element_size() <= RETAINED_BYTES:
        _free.setdefault((slab.dtype, slab.numel()), []).append(slab)


def clear() -> None:
    """Free every retained buffer."""
    _free.clear()
