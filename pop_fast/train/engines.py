"""Which engine takes the steps of a run, and which backend measures and draws what was trained.

Steps are taken by autograd over a backend's stages, or by the whole step that a backend offers. A backend on a GPU has
the interface of one on the CPU (`GpuProxy`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from pop_fast.api.backend import Backend, Renderer, by_speed, fastest_backend, get_backend, require_backend
from pop_fast.api.rasterize import RenderMeta
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.stepper import Engine, FusedStepper, Stepper, Task
from pop_fast.train.steps import why_not_trained
from pop_fast.train.torch_stepper import BatchStepper, TorchStepper


def engine_of(config: TrainConfig, own_strategy: bool = True) -> Engine:
    """Return the engine for a run's backend and settings.

    Args:
        config: with a backend's name; "auto" is "fast" here, see `choose_backend`.

    Raises:
        PopError: the backend is unknown or cannot run here, or does not know a setting.
    """
    backend = require_backend("fast" if config.backend == "auto" else config.backend)
    reason = why_not_trained(backend, config, own_strategy)
    if reason is not None:
        raise PopError(reason)
    step = backend.whole_step()
    if step is not None and own_strategy and step.unknown_setting(config) is None:
        return whole_engine(backend)
    return torch_engine(backend)


def torch_engine(backend: str | Backend) -> Engine:
    """Return autograd over the stages of a backend for CPU tensors; PopError where it is unknown or cannot run here."""
    drawing = require_backend(backend)

    def by_autograd(task: Task) -> Stepper:
        return (TorchStepper if task.config.batch_size == 1 else BatchStepper)(task, drawing)

    return Engine(drawing.name, torch.device("cpu"), drawing, by_autograd)


def whole_engine(backend: str | Backend = "compiled") -> Engine:
    """Return the whole step that a backend offers; PopError where it is unknown, cannot run here, or offers none."""
    drawing = require_backend(backend)
    step = drawing.whole_step()
    if step is None:
        raise PopError(f"backend {drawing.name!r} has no step of its own; autograd over its stages takes them")

    def whole(task: Task) -> Stepper:
        return FusedStepper(task, step.name, step.most, step.make(task))

    if drawing.device == "cpu":
        return Engine(drawing.name, torch.device("cpu"), drawing, whole, depends_on_threads=step.depends_on_threads)
    # without it, torch's deterministic mode refuses the small products that place the children of a split
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    device = torch.device(drawing.device, torch.cuda.current_device())

    def facts() -> dict[str, Any]:
        memory = torch.cuda.max_memory_allocated(device)
        return {"gpu": torch.cuda.get_device_name(device), "gpu_memory_bytes": memory}

    proxy = GpuProxy(drawing, device)
    return Engine(drawing.name, device, proxy, whole, facts, depends_on_threads=step.depends_on_threads)


_LESS = "use smaller images (--factor 2 or more), fewer Gaussians, or a card with more memory"


class GpuProxy:
    """Renders tensors of any device on one device, and hands images and `info` back on the CPU."""

    def __init__(self, backend: Renderer, device: torch.device) -> None:
        self._backend, self.device = backend, device

    @property
    def name(self) -> str:
        return self._backend.name

    def available(self) -> bool:
        return self._backend.available()

    def why_not(self) -> str | None:
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
    """Turn what says that the GPU's memory is full into a PopError on what to lower."""
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
