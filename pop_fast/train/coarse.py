"""Coarse to fine: the photographs that the first steps are compared with are smaller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import torch

from pop_fast.train.views import ViewTensors


def with_coarser(views, levels):
    found = list(views)
    for level in range(1, levels + 1):
        found += [coarser(view, 2**level) for view in views]
    return found


def coarser(view: ViewTensors, factor: int) -> ViewTensors:
    height, width = max(round(view.height / factor), 1), max(round(view.width / factor), 1)
    K = view.K.clone()
    K[:, 0] *= width / view.width
    K[:, 1] *= height / view.height
    photo = torch.from_numpy(cv2.resize(view.photo.numpy(), (width, height), interpolation=cv2.INTER_AREA))
    mask = None
    if view.mask is not None:
        mask = torch.from_numpy(cv2.resize(view.mask.float().numpy(), (width, height), interpolation=cv2.INTER_AREA) >= 0.5)
    return replace(view, photo=photo, mask=mask, K=K)


def coarse_order(order: Sequence[int], coarse_iters: Sequence[int], n: int, size: int = 1) -> list[int]:
    return [index + n * sum(place // size < stop for stop in coarse_iters) for place, index in enumerate(order)]
