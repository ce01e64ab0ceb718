"""Whole training steps on a GPU, by the kernels of `cuda_ext`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch

from cuda_ext.training.batch_step import BatchTrainer
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.train.stepper import Fused, MakeFused, Rows, Task
from pop_fast.train.steps import StepSettings
from pop_fast.train.views import ViewTensors

# of the card's free memory, what photographs may take, and their blurred values; the rest is for Gaussians and lists
PHOTOGRAPHS_SHARE = 0.25
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


def make_fused(task: Task) -> MakeFused:
    """Return what makes the fused step, with the photographs on the GPU."""
    return partial(_fused, task)


def _fused(
    task: Task,
    params: Rows,
    m: Rows,
    v: Rows,
    views: Sequence[ViewTensors],
    order: Sequence[int],
    settings: StepSettings,
    step: int,
) -> Fused:
    given = (params, m, v, _resident(views, settings, params["means"].device), order, settings, step)
    size = task.config.batch_size
    return FusedTrainer(*given) if size == 1 else BatchTrainer(*given, size, task.ranks)


def _resident(views: Sequence[ViewTensors], settings: StepSettings, device: torch.device) -> ResidentViews:
    pixels = sum(view.height * view.width for view in views)
    free, _ = torch.cuda.mem_get_info(device)
    cameras = (torch.cat([view.viewmat for view in views]), torch.cat([view.K for view in views]))
    given = ([view.photo for view in views], *cameras, [view.mask for view in views], settings.padding, device)
    keeps = _BYTES_OF_MOMENTS * pixels <= MOMENTS_SHARE * free
    return ResidentViews(*given, cache_moments=keeps, room=int(PHOTOGRAPHS_SHARE * free))
