"""The emulated GPU as an engine of `pop train`."""

from __future__ import annotations

import torch

from pop_fast.api.registry import get_backend
from pop_fast.train.engines import cuda_stepper
from pop_fast.train.gpu_proxy import GpuProxy
from pop_fast.train.stepper import Engine


def emulated_engine() -> Engine:
    """Return the emulated GPU, once it is installed, as `pop train` takes one."""
    device = torch.device("cpu")
    return Engine("cuda", device, GpuProxy(get_backend("cuda"), device), cuda_stepper, lambda: {"gpu": "emulated"})
