"""Which engine takes the steps of a run: autograd over a backend's stages, the native step, the fused one on a GPU."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from cuda_ext.train_settings import StepSettings
from pop_fast.api.backend import Backend
from pop_fast.api.registry import require_backend
from pop_fast.train.batch_stepper import BatchStepper
from pop_fast.train.config import TrainConfig
from pop_fast.train.fused_stepper import Fused, FusedStepper, MakeFused, Rows
from pop_fast.train.gpu_proxy import GpuProxy
from pop_fast.train.stepper import Engine, Task
from pop_fast.train.torch_stepper import TorchStepper
from pop_fast.train.views import ViewTensors

# so many steps at most before the host looks up from a GPU, however quick they are: Ctrl-C, the progress bar
MOST_ON_GPU = 500
# and from a CPU
MOST_ON_CPU = 20
# of the card's free memory, what the photographs' blurred values may take; the rest is for Gaussians and tile lists
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


def engine_of(config: TrainConfig, own_strategy: bool = True) -> Engine:
    """Return the engine for a run's backend and settings.

    Args:
        config: with a backend's name; "auto" is "fast" here, see `choose_backend`.
        own_strategy: whether the density strategy is one of this package.

    Raises:
        PopError: the backend is unknown or cannot run here, or does not know a setting.
    """
    return require_backend("fast" if config.backend == "auto" else config.backend).make_engine(config, own_strategy)


def torch_engine(backend: str | Backend) -> Engine:
    """Return autograd over the stages of a backend for CPU tensors.

    Args:
        backend: it, or its name.

    Raises:
        PopError: it is unknown or cannot run here.
    """
    drawing = require_backend(backend if isinstance(backend, str) else backend.name)
    return Engine(drawing.name, torch.device("cpu"), drawing, lambda task: _by_autograd(task, drawing))


def _by_autograd(task: Task, drawing: Backend) -> TorchStepper:
    return (TorchStepper if task.config.batch_size == 1 else BatchStepper)(task, drawing)


def native_engine(backend: str | Backend = "compiled") -> Engine:
    """Return the whole step in C++.

    Args:
        backend: what draws for measurements.

    Raises:
        PopError: it is not compiled.
    """
    return replace(
        torch_engine(backend),
        make_stepper=lambda task: FusedStepper(task, "native", MOST_ON_CPU, _native_trainer(task)),
        depends_on_threads=False,
    )


def _native_trainer(task: Task) -> MakeFused:
    """Make the native step, with what it needs of the photographs in the memory that the settings give it."""
    from pop_fast.compiled.native_step import NativeTrainer

    return partial(NativeTrainer, cache_mb=task.config.target_cache_mb, stop=task.stop)


def cuda_engine() -> Engine:
    """Return the fused step on torch's current GPU.

    Raises:
        PopError: backend "cuda" cannot run here.
    """
    backend = require_backend("cuda")
    # without it, torch's deterministic mode refuses the small products that place the children of a split
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    device = torch.device("cuda", torch.cuda.current_device())

    def facts() -> dict[str, Any]:
        memory = torch.cuda.max_memory_allocated(device)
        return {"gpu": torch.cuda.get_device_name(device), "gpu_memory_bytes": memory}

    return Engine("cuda", device, GpuProxy(backend, device), cuda_stepper, facts)


def cuda_stepper(task: Task) -> FusedStepper:
    """Make what takes the steps on a GPU."""
    return FusedStepper(task, "cuda", MOST_ON_GPU, _fused_trainer)


def _fused_trainer(
    params: Rows,
    m: Rows,
    v: Rows,
    views: Sequence[ViewTensors],
    order: Sequence[int],
    settings: StepSettings,
    step: int,
) -> Fused:
    """Make the fused step, with the photographs on the GPU."""
    from cuda_ext.training.resident import ResidentViews
    from cuda_ext.training.train_step import FusedTrainer

    device = params["means"].device
    pixels = sum(view.height * view.width for view in views)
    free, _ = torch.cuda.mem_get_info(device)
    resident = ResidentViews(
        [view.photo for view in views],
        torch.cat([view.viewmat for view in views]),
        torch.cat([view.K for view in views]),
        [view.mask for view in views],
        settings.padding,
        device,
        cache_moments=_BYTES_OF_MOMENTS * pixels <= MOMENTS_SHARE * free,
    )
    return FusedTrainer(params, m, v, resident, order, settings, step)
