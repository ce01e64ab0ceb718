"""A backend on a GPU with the interface of one on the CPU, and which backend measures and draws what was trained."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from pop_fast.api.backend import Renderer
from pop_fast.api.meta import RenderMeta
from pop_fast.api.registry import by_speed, fastest_backend, get_backend
from pop_fast.errors import PopError

_LESS = "use smaller images (--factor 2 or more), fewer Gaussians, or a card with more memory"


class GpuProxy:
    """Renders tensors of any device on one device, and hands images and `info` back on the CPU.

    Args:
        backend: what renders there.
        device: where.
    """

    def __init__(self, backend: Renderer, device: torch.device) -> None:
        self._backend, self.device = backend, device

    @property
    def name(self) -> str:
        """Return the backend's name."""
        return self._backend.name

    def available(self) -> bool:
        """Tell whether it can run here."""
        return self._backend.available()

    def why_not(self) -> str | None:
        """Return why it cannot run here and what to do, or None."""
        return self._backend.why_not()

    def rasterization(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, RenderMeta]:
        """Render; see `pop_fast.api.rasterize.rasterization`. No gradient comes back.

        Raises:
            PopError: the GPU has no room; says what to lower.
        """
        there = [self._moved(value) for value in args]
        named = {key: self._moved(value) for key, value in kwargs.items()}
        with translate_oom(), torch.no_grad():
            image, alphas, info = self._backend.rasterization(*there, **named)
        return image.cpu(), alphas.cpu(), info.changed(_fetched)

    def _moved(self, value: Any) -> Any:
        return value.to(self.device) if isinstance(value, Tensor) else value


def _fetched(value: Any) -> Any:
    return value.detach().cpu() if isinstance(value, Tensor) else value


@contextmanager
def translate_oom() -> Iterator[None]:
    """Turn what says that the GPU's memory is full into a sentence on what to lower.

    Raises:
        PopError: the memory is full.
    """
    from cuda_ext.arrays import CudaMemoryError

    try:
        yield
    except CudaMemoryError as error:
        raise PopError(f"{error}; {_LESS}") from error
    except torch.cuda.OutOfMemoryError as error:
        raise PopError(f"the GPU has no room ({str(error).split('. ')[0]}); {_LESS}") from error
    # what is asked of the driver itself, a stream for one, is told as any other failed call
    except torch.AcceleratorError as error:
        if "out of memory" not in str(error):
            raise
        raise PopError(f"the GPU has no room ({str(error).splitlines()[0]}); {_LESS}") from error


def renderer(name: str) -> tuple[Renderer, str | None]:
    """Return the backend for CPU tensors under a name of settings, and a note where another one stands in for it.

    "auto" is the fastest that can run here; results trained by one that "auto" takes elsewhere, and that cannot run
    here, are drawn by the fastest on the CPU.

    Raises:
        PopError: the name is unknown.
    """
    chosen = next(b for b in by_speed() if b.available()) if name == "auto" else get_backend(name)
    if chosen.available() or chosen.speed is None:
        on_cpu = chosen.device == "cpu"
        return chosen if on_cpu else GpuProxy(chosen, torch.device(chosen.device, torch.cuda.current_device())), None
    drawing = fastest_backend("cpu")
    return drawing, f"backend {drawing.name!r} stands in for {name!r}: {chosen.why_not()}"
