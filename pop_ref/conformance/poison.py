"""Poisoned allocations: what torch.empty hands out is NaN, so that a lane that nobody writes becomes visible."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

FUNCTIONS = ("empty", "empty_like", "empty_strided")
METHODS = ("new_empty", "new_empty_strided")
# an index nobody means, far outside every array
POISONED_INTEGER = -(2**30)


@contextmanager
def poisoned_allocations(package: str) -> Iterator[None]:
    """Fill uninitialised tensors that a package asks for with NaN, integers with a wild index, truths with True."""
    torch = importlib.import_module("torch")
    places = [(torch, name) for name in FUNCTIONS] + [(torch.Tensor, name) for name in METHODS]
    originals = {(owner, name): getattr(owner, name) for owner, name in places}
    for (owner, name), original in originals.items():
        setattr(owner, name, _poisoning(original, package, torch))
    try:
        yield
    finally:
        for (owner, name), original in originals.items():
            setattr(owner, name, original)


def _poisoning(original: Callable[..., Any], package: str, torch: Any) -> Callable[..., Any]:
    @functools.wraps(original)
    def allocate(*args: Any, **kwargs: Any) -> Any:
        tensor = original(*args, **kwargs)
        caller = sys._getframe(1).f_globals.get("__name__", "")
        if caller.split(".")[0] == package:
            _fill(tensor, torch)
        return tensor

    return allocate


def _fill(tensor: Any, torch: Any) -> None:
    with torch.no_grad():
        if tensor.is_floating_point():
            tensor.fill_(float("nan"))
        elif tensor.dtype == torch.bool:
            tensor.fill_(True)
        elif tensor.dtype in (torch.int32, torch.int64):
            tensor.fill_(POISONED_INTEGER)
        else:
            tensor.fill_(1)
