"""Reusable buffers: fresh pages cost more than the arithmetic that fills them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

RETAINED_BYTES = 1 << 30


class _Pool:
    def __init__(self) -> None:
        self.free: dict[tuple[torch.dtype, int], list[Tensor]] = {}
        self.retained = 0


_pool = _Pool()


def acquire(numel: int, dtype: torch.dtype) -> Tensor:
    """Return a flat buffer of at least `numel` uninitialised numbers, used before if one is free.

    Lengths are powers of two, so that scenes whose sizes change from step to step share a few kinds of buffers.
    """
    length = 1 << max(numel - 1, 0).bit_length()
    free = _pool.free.get((dtype, length))
    if not free:
        return torch.empty(length, dtype=dtype)
    _pool.retained -= length * dtype.itemsize
    return free.pop()


def release(slab: Tensor) -> None:
    """Return a buffer from `acquire`, or a view of one's beginning; nobody may use it afterwards."""
    size = slab.untyped_storage().nbytes()
    slab = slab.as_strided((size // slab.itemsize,), (1,), 0)
    if _pool.retained + size <= RETAINED_BYTES:
        _pool.retained += size
        _pool.free.setdefault((slab.dtype, slab.numel()), []).append(slab)


def copy(tensor: Tensor) -> Tensor:
    """Return a copy in a buffer from `acquire`, which `release` takes back."""
    return acquire(tensor.numel(), tensor.dtype)[: tensor.numel()].view(tensor.shape).copy_(tensor)


@contextmanager
def acquired(n: int, numel: int, dtype: torch.dtype) -> Iterator[list[Tensor]]:
    """Lend `n` buffers of at least `numel` numbers for a block of code."""
    taken = [acquire(numel, dtype) for _ in range(n)]
    try:
        yield taken
    finally:
        for slab in taken:
            release(slab)


def retained_bytes() -> int:
    """Return how much memory waits to be used again."""
    return _pool.retained


def clear() -> None:
    """Free every retained buffer."""
    _pool.free.clear()
    _pool.retained = 0
