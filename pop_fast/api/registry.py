"""Backends by name: "fast" (torch, CPU), "compiled" (C++, CPU), "cuda" (cuda_ext), "ref" (the oracle, slow), and those
that other packages register under the entry point group `pop_splatting.backends`.

Which one runs is a value that is passed; nothing is patched, so two can be alive in one process and be compared in one
assertion. Asking which there are, and why one cannot run, imports no torch.
"""

from __future__ import annotations

import functools
import importlib
from importlib.metadata import entry_points
from typing import Any, Final

from pop_fast.api.backend import Backend
from pop_fast.errors import PopError

GROUP: Final = "pop_splatting.backends"
# written as entry points are, and known without an installation: a checkout on the path has all of its own
OWN: Final = {
    "fast": "pop_fast.stages.backend:FAST",
    "compiled": "pop_fast.compiled.backend:COMPILED",
    "cuda": "pop_fast.cuda.backend:CUDA",
    "ref": "pop_fast.oracle.backend:REF",
}


def is_own(name: str) -> bool:
    """Tell whether a backend is one of this package, which needs no look at what is installed."""
    return name in OWN


def backend_names() -> tuple[str, ...]:
    """Return the names that `get_backend` knows."""
    return (*OWN, *(name for name in _foreign() if name not in OWN))


def get_backend(name: str) -> Backend:
    """Return the backend of that name, whether or not it can run here.

    Raises:
        PopError: the name is unknown, or another package registered something under it that cannot be imported.
    """
    if name not in backend_names():
        raise PopError(f"backend {name!r} is unknown; use one of {', '.join(backend_names())}")
    return _loaded(OWN.get(name) or _foreign()[name])


def fastest_backend(device: str) -> Backend:
    """Return the fastest backend for tensors on a kind of device that can run here.

    Args:
        device: as `torch.device.type` says it.

    Raises:
        PopError: none can; says why.
    """
    known = [b for b in map(get_backend, backend_names()) if b.device == device and b.speed is not None]
    for backend in sorted(known, key=lambda b: b.speed or 0, reverse=True):
        if backend.why_not() is None:
            return backend
    reasons = "; ".join(f"backend {b.name!r} cannot run: {b.why_not()}" for b in known)
    raise PopError(reasons or f"no backend renders tensors on {device!r}; move them to the CPU")


def require_backend(name: str) -> Backend:
    """Return a backend that can run here.

    Raises:
        PopError: it is unknown, or cannot; says why and what to do.
    """
    backend = get_backend(name)
    reason = backend.why_not()
    if reason is not None:
        raise PopError(f"backend {name!r} cannot run: {reason}")
    return backend


@functools.cache
def _foreign() -> dict[str, str]:
    return {entry.name: entry.value for entry in entry_points(group=GROUP)}


@functools.cache
def _loaded(path: str) -> Any:
    module, _, attribute = path.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise PopError(f"the backend at {path} cannot be loaded: {error}") from error
