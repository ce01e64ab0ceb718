"""Whole training steps on a GPU, by the kernels of `cuda_ext`."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from cuda_ext.training.resident import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.train.fused_stepper import Rows
from pop_fast.train.steps import StepSettings
from pop_fast.train.views import ViewTensors

# of the card's free memory, what the photographs' blurred values may take; the rest is for Gaussians and tile lists
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


def fused_trainer(
    params: Rows,
    m: Rows,
    v: Rows,
    views: Sequence[ViewTensors],
    order: Sequence[int],
    settings: StepSettings,
    step: int,
) -> FusedTrainer:
    """Make the fused step, with the photographs on the GPU."""
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
