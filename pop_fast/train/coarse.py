"""Coarse to fine: the first steps see the photographs shrunk, whose large shapes are learned at a fraction of the cost.

`coarse_stop_iters` = (a, b) shrinks by 4 until step a and by 2 until step b. What a step sees is a view like any other,
so that nothing of a step's meaning changes: its photograph is the average of the original's pixels, its camera the same
one with fewer pixels. Densification reads the gradients and the dominated pixels of the view as it is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import cv2
import numpy as np
import torch
from torch import Tensor

from pop_fast.train.views import ViewTensors

# px, a side that no view is shrunk below: a few of SSIM's windows of 11
SMALLEST_SIDE: Final = 32


def coarse_to_fine(
    views: Sequence[ViewTensors], order: Sequence[int], stops: Sequence[int], size: int
) -> tuple[list[ViewTensors], list[int]]:
    """Return the views at every size that is seen, and which of them every step sees.

    Args:
        views: to train on.
        order: the views of every step, `size` of them a step.
        stops: `coarse_stop_iters`.
        size: views of a step.
    """
    return with_shrunk(views, stops), [
        index_at(place // size, index, len(views), stops) for place, index in enumerate(order)
    ]


def with_shrunk(views: Sequence[ViewTensors], stops: Sequence[int]) -> list[ViewTensors]:
    """Return the views, then all of them shrunk by 2, by 4 and so on, one power for every entry of `stops`."""
    return [shrunk(view, 2**level) for level in range(len(stops) + 1) for view in views]


def index_at(step: int, index: int, n_views: int, stops: Sequence[int]) -> int:
    """Return where the view that a step sees stands in `with_shrunk`.

    Args:
        step: counts from 0.
        index: of the view.
        n_views: how many there are.
        stops: `coarse_stop_iters`.
    """
    return index + n_views * sum(step < stop for stop in stops)


def shrunk(view: ViewTensors, factor: int) -> ViewTensors:
    """Return a view with a smaller photograph, and the camera that takes it.

    Args:
        view: any.
        factor: power of 2, of which as much is used as leaves a side of 32 px.

    Returns:
        The view of round(H / factor) by round(W / factor) px; a pixel counts where half of what it averages does.
    """
    while factor > 1 and min(view.height, view.width) < SMALLEST_SIDE * factor:
        factor //= 2
    if factor == 1:
        return view
    height, width = round(view.height / factor), round(view.width / factor)

    def small(image: Tensor) -> Tensor:
        resized = cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
        return torch.from_numpy(np.ascontiguousarray(resized))

    K = view.K.clone()
    K[:, 0] *= width / view.width
    K[:, 1] *= height / view.height
    mask = None if view.mask is None else small(view.mask.float()) >= 0.5
    if mask is not None and not mask.any():
        return shrunk(view, factor // 2)
    alpha = None if view.alpha is None else small(view.alpha)
    return replace(view, photo=small(view.photo), mask=mask, K=K, alpha=alpha)
