"""Whole training steps on a GPU, by the kernels of `cuda_ext`."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from cuda_ext.training.batch_step import BatchTrainer
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.train.fused_stepper import Fused, MakeFused, Rows
from pop_fast.train.stepper import Task
from pop_fast.train.steps import StepSettings
from pop_fast.train.views import ViewTensors

# of the card's free memory, what photographs may take, and their blurred values; the rest is for Gaussians and lists
PHOTOGRAPHS_SHARE = 0.25
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


def make_fused(task: Task) -> MakeFused:
    """Return what makes the fused step, with the photographs on the GPU."""

    def make(
        params: Rows,
        m: Rows,
        v: Rows,
        views: Sequence[ViewTensors],
        order: Sequence[int],
        settings: StepSettings,
        step: int,
    ) -> Fused:
        resident = _resident(views, settings, params["means"].device)
        size = task.config.batch_size
        if size == 1:
            return FusedTrainer(params, m, v, resident, order, settings, step)
        return BatchTrainer(params, m, v, resident, order, settings, step, size, task.ranks)

    return make


def _resident(views: Sequence[ViewTensors], settings: StepSettings, device: torch.device) -> ResidentViews:
    pixels = sum(view.height * view.width for view in views)
    free, _ = torch.cuda.mem_get_info(device)
    return ResidentViews(
        [view.photo for view in views],
        torch.cat([view.viewmat for view in views]),
        torch.cat([view.K for view in views]),
        [view.mask for view in views],
        settings.padding,
        device,
        cache_moments=_BYTES_OF_MOMENTS * pixels <= MOMENTS_SHARE * free,
        room=int(PHOTOGRAPHS_SHARE * free),
    )
