"""The emulated GPU as an engine of `pop train`."""

from __future__ import annotations

import torch

from pop_fast.api.registry import get_backend
from pop_fast.train.fused_stepper import FusedStepper
from pop_fast.train.gpu_proxy import GpuProxy
from pop_fast.train.stepper import Engine, Task


def emulated_engine() -> Engine:
    """Return the emulated GPU, once it is installed, as `pop train` takes one."""
    device, cuda = torch.device("cpu"), get_backend("cuda")
    step = cuda.whole_step()
    assert step is not None

    def stepper(task: Task) -> FusedStepper:
        return FusedStepper(task, step.name, step.most, step.make(task))

    return Engine("cuda", device, GpuProxy(cuda, device), stepper, lambda: {"gpu": "emulated"})
