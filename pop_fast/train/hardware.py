"""Where a run is done that lets the device take many steps at a time, and by what."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from cuda_ext.train_settings import Phase, Statistics, StepSettings, StepValues
from pop_fast.backends import Backend, get_backend
from pop_fast.errors import PopError
from pop_fast.train.views import ViewTensors

Rows = Mapping[str, Tensor]
# of the card's free memory, what the photographs' blurred values may take; the rest is for Gaussians and tile lists
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


class Stepper(Protocol):
    """What takes the steps: `cuda_ext.train_step.FusedTrainer`, where each of these is explained."""

    step: int
    grown: int

    @property
    def statistics(self) -> Statistics:
        """What density control reads."""
        ...

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        """Take new rows after a density event; statistics start from nothing."""
        ...

    def run(self, until: int, phase: Phase) -> None:
        """Take steps of one phase until the counter stands at `until`."""
        ...

    def told(self, first: int, last: int) -> list[StepValues]:
        """Return what the steps from `first` to before `last` told."""
        ...


# parameters, first and second moments, the views, the view of every step, settings, the step to begin at
MakeStepper = Callable[[Rows, Rows, Rows, Sequence[ViewTensors], Sequence[int], StepSettings, int], Stepper]


@dataclass(frozen=True)
class Hardware:
    """Where and by what a run is done.

    Attributes:
        device: holds the run.
        backend: renders there.
        make_stepper: takes the steps there.
        facts: goes into the statistics.
    """

    device: torch.device
    backend: Backend
    make_stepper: MakeStepper
    facts: Callable[[], dict[str, Any]]


def this_machine() -> Hardware:
    """Return torch's current GPU and the fused step on it.

    Raises:
        PopError: backend "cuda" cannot run here.
    """
    backend = get_backend("cuda")
    reason = backend.why_not()
    if reason is not None:
        raise PopError(f"backend 'cuda' is not available: {reason}")
    # without it, torch's deterministic mode refuses the small products that place the children of a split
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    device = torch.device("cuda", torch.cuda.current_device())

    def facts() -> dict[str, Any]:
        memory = torch.cuda.max_memory_allocated(device)
        return {"gpu": torch.cuda.get_device_name(device), "gpu_memory_bytes": memory}

    return Hardware(device, backend, fused_stepper, facts)


def fused_stepper(
    params: Rows,
    m: Rows,
    v: Rows,
    views: Sequence[ViewTensors],
    order: Sequence[int],
    settings: StepSettings,
    step: int,
) -> Stepper:
    """Make what takes the steps on a GPU, with the photographs on it."""
    from cuda_ext.resident import ResidentViews
    from cuda_ext.train_step import FusedTrainer

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
