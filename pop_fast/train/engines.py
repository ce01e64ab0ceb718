"""Which engine takes the steps of a run: autograd over a backend's stages, or the whole step that a backend offers."""

from __future__ import annotations

import os
from typing import Any

import torch

from pop_fast.api.backend import Backend
from pop_fast.api.registry import require_backend
from pop_fast.errors import PopError
from pop_fast.train.batch_stepper import BatchStepper
from pop_fast.train.config import TrainConfig
from pop_fast.train.fused_stepper import FusedStepper
from pop_fast.train.gpu_proxy import GpuProxy
from pop_fast.train.stepper import Engine, Stepper, Task
from pop_fast.train.steps import why_not_trained
from pop_fast.train.torch_stepper import TorchStepper


def engine_of(config: TrainConfig, own_strategy: bool = True) -> Engine:
    """Return the engine for a run's backend and settings.

    Args:
        config: with a backend's name; "auto" is "fast" here, see `choose_backend`.
        own_strategy: whether the density strategy is one of this package.

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
    """Return autograd over the stages of a backend for CPU tensors.

    Args:
        backend: it, or its name.

    Raises:
        PopError: it is unknown or cannot run here.
    """
    drawing = require_backend(backend if isinstance(backend, str) else backend.name)

    def by_autograd(task: Task) -> Stepper:
        return (TorchStepper if task.config.batch_size == 1 else BatchStepper)(task, drawing)

    return Engine(drawing.name, torch.device("cpu"), drawing, by_autograd)


def whole_engine(backend: str | Backend = "compiled") -> Engine:
    """Return the whole step that a backend offers.

    Args:
        backend: it, or its name.

    Raises:
        PopError: it is unknown, cannot run here, or offers none.
    """
    drawing = require_backend(backend if isinstance(backend, str) else backend.name)
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
