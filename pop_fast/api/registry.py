"""Backends by name: those of this package, which `pop_fast.api` registers, and those of other packages.

Another package declares its own under the entry point group `pop_splatting.backends`, or calls `BACKENDS.register`.
Which one runs is a value that is passed; nothing is patched, so two can be alive in one process and be compared in one
assertion. Asking which there are, and why one cannot run, imports no torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from pop_fast.api.backend import Backend
from pop_fast.errors import PopError
from pop_ref.registry import Registry

BACKENDS: Final[Registry[Backend]] = Registry(
    "backend",
    "pop_splatting.backends",
    needs=("name", "device", "dtypes", "speed", "lacks", "why_not", "stages", "losses", "open_view", "whole_step"),
    error=PopError,
)


def backend_names() -> tuple[str, ...]:
    """Return the names that `get_backend` knows."""
    return tuple(BACKENDS)


def get_backend(name: str) -> Backend:
    """Return the backend of that name, whether or not it can run here.

    Raises:
        PopError: the name is unknown, or another package registered something under it that cannot be imported.
    """
    return BACKENDS.named(name)


def by_speed() -> Iterator[Backend]:
    """Give the backends that "auto" may take, the fastest first; one that cannot be imported is none."""
    found: list[tuple[int, Backend]] = []
    for name in BACKENDS:
        try:
            backend = BACKENDS.named(name)
        except PopError:
            continue
        if backend.speed is not None:
            found.append((backend.speed, backend))
    yield from (backend for _, backend in sorted(found, key=lambda pair: pair[0], reverse=True))


def fastest_backend(device: str) -> Backend:
    """Return the fastest backend for tensors on a kind of device that can run here.

    Args:
        device: as `torch.device.type` says it.

    Raises:
        PopError: none can; says why.
    """
    known = [backend for backend in by_speed() if backend.device == device]
    for backend in known:
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
