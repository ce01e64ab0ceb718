"""Backends by name: "fast" (this package in torch, CPU), "compiled" (the same with C++ kernels), "cuda" (cuda_ext),
"ref" (the oracle, slow).

A backend offers `rasterization()` with gsplat's signature and this project's meta keys. Which one runs is a value that
is passed; nothing is patched, so two can be alive in one process and be compared in one assertion.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Protocol

from pop_fast.errors import PopError

if TYPE_CHECKING:
    from torch import Tensor


class Backend(Protocol):
    """What a trainer or a test asks of a backend."""

    @property
    def name(self) -> str:
        """Return the backend's name."""
        ...

    def available(self) -> bool:
        """Tell whether it can run here."""
        ...

    def why_not(self) -> str | None:
        """Return one sentence on why it cannot run here and what to do, or None."""
        ...

    def rasterization(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Render; see `pop_fast.api.rasterize.rasterization`."""
        ...


@dataclass(frozen=True)
class _Registered:
    name: str
    load: Callable[[], Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]]
    reason: Callable[[], str | None]

    def available(self) -> bool:
        return self.reason() is None

    def why_not(self) -> str | None:
        return self.reason()

    def rasterization(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
        require_backend(self.name)
        return self.load()(*args, **kwargs)


def _load_fast() -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    from pop_fast.api.rasterize import rasterization

    return partial(rasterization, backend="fast")


def _load_compiled() -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    from pop_fast.compiled.rasterization import rasterization

    return rasterization


def _why_not_compiled() -> str | None:
    from pop_fast.compiled import why_not

    return why_not()


def _load_ref() -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    from pop_fast.oracle.rasterize import rasterization

    return rasterization


def _load_cuda() -> Callable[..., tuple[Tensor, Tensor, dict[str, Any]]]:
    from cuda_ext.render.ops import rasterization

    return rasterization


def _why_not_cuda() -> str | None:
    from cuda_ext import why_not

    return why_not()


_BACKENDS: dict[str, Backend] = {
    "fast": _Registered("fast", _load_fast, lambda: None),
    "compiled": _Registered("compiled", _load_compiled, _why_not_compiled),
    "cuda": _Registered("cuda", _load_cuda, _why_not_cuda),
    "ref": _Registered("ref", _load_ref, lambda: None),
}


def backend_names() -> tuple[str, ...]:
    """Return the names that `get_backend` knows."""
    return tuple(_BACKENDS)


def get_backend(name: str) -> Backend:
    """Return the backend of that name, whether or not it can run here.

    Raises:
        PopError: the name is unknown.
    """
    if name not in _BACKENDS:
        raise PopError(f"backend {name!r} is unknown; use one of {', '.join(_BACKENDS)}")
    return _BACKENDS[name]


def fastest_backend(device: str) -> Literal["fast", "compiled", "cuda"]:
    """Return the fastest backend for tensors on a kind of device that can run here.

    Args:
        device: as `torch.device.type` says it.
    """
    if device == "cuda":
        return "cuda"
    return "compiled" if get_backend("compiled").available() else "fast"


def require_backend(name: str) -> None:
    """Make sure that a backend can run here.

    Raises:
        PopError: it is unknown, or cannot; says why and what to do.
    """
    reason = get_backend(name).why_not()
    if reason is not None:
        raise PopError(f"backend {name!r} cannot run: {reason}")
