"""The photometric loss of a training view: (1 - lambda) L + lambda (1 - SSIM), with POP's L2 or 3DGS's L1 as L."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cuda_ext.train_settings import Phase
from pop_fast.api.registry import get_backend
from pop_fast.stages import losses
from pop_fast.stages.losses import TargetMoments, target_moments
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors


class Objective:
    """Compares renders with the photographs of the training views.

    What SSIM needs of a photograph alone is computed at its first visit and kept, for as many views as
    `target_cache_mb` has room for; the others compute it anew at every visit, to the same bits.

    Args:
        config: step numbers as they are run.
        views: to train on.
        backend: whose losses are taken.
    """

    def __init__(self, config: TrainConfig, views: Sequence[ViewTensors], backend: str) -> None:
        self._config = config
        self._views = views
        self._kept: dict[int, TargetMoments] = {}
        self._background = torch.tensor(config.background, dtype=torch.float64)
        self._room = config.target_cache_mb * 2**20
        self._losses = get_backend(backend).losses()

    def __call__(self, image: Tensor, index: int, phase: Phase, background: Tensor | None = None) -> Tensor:
        """Return the loss of a render [H, W, 3] of view `index`, over another background if one is given."""
        config, moments, mask = self._config, self._moments(index, background), self._views[index].mask
        weight, scale = phase.lambda_ssim, 1.0 / config.photometric_divisor
        common = (weight, config.ssim_padding, mask, config.d_ssim_halved, scale)
        if phase.l1:
            return self._losses.photometric_3dgs(image, moments.target, *common, moments=moments)
        return self._losses.photometric_pop(image, moments.target, *common, moments=moments)

    def measure(
        self, image: Tensor, index: int, l1: bool, background: Tensor | None = None
    ) -> tuple[float, float, float]:
        """Return mean L1 or L2, SSIM, and the mean square of the difference with the render clamped to [0, 1]."""
        moments, mask = self._moments(index, background), self._views[index].mask
        target, padding = moments.target, self._config.ssim_padding
        pixelwise = (losses.l1 if l1 else losses.l2)(image, target, mask)
        d_ssim = self._losses.d_ssim(image, target, padding, mask, False, moments)
        square = losses.l2(image.clamp(0.0, 1.0), target, mask)
        return float(pixelwise), 1.0 - float(d_ssim), float(square)

    def _moments(self, index: int, background: Tensor | None) -> TargetMoments:
        view = self._views[index]
        if background is not None and view.alpha is not None:
            # every step has another one
            return target_moments(view.target_over(background, self._background), self._config.ssim_padding)
        if index in self._kept:
            return self._kept[index]
        moments = target_moments(view.target(), self._config.ssim_padding)
        needed = sum(t.numel() * t.element_size() for t in (moments.target, moments.mu_y, moments.s_yy))
        if needed <= self._room:
            self._room -= needed
            self._kept[index] = moments
        return moments
