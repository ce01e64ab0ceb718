"""The photometric loss of a training view: (1 - lambda) L + lambda (1 - SSIM), with POP's L2 or 3DGS's L1 as L."""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType

from torch import Tensor

from pop_fast import losses
from pop_fast.losses import TargetMoments, target_moments
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors


class Objective:
    """Compares renders with the photographs of the training views.

    What SSIM needs of a photograph alone is computed at its first visit and kept, for as many views as
    `target_cache_mb` has room for; the others compute it anew at every visit, to the same bits.
    """

    def __init__(self, config: TrainConfig, views: Sequence[ViewTensors]) -> None:
        self._config = config
        self._views = views
        self._kept: dict[int, TargetMoments] = {}
        self._room = config.target_cache_mb * 2**20
        self._losses = _losses_of(config.backend)

    def __call__(self, image: Tensor, index: int, step: int) -> Tensor:
        """Return the loss of a render [H, W, 3] of view `index` at a step."""
        config, moments, mask = self._config, self._moments(index), self._views[index].mask
        kind, weight = config.photometric_at(step)
        common = (weight, config.ssim_padding, mask, config.d_ssim_halved, 1.0 / config.photometric_divisor)
        if kind == "l1":
            return self._losses.photometric_3dgs(image, moments.target, *common, moments=moments)
        return self._losses.photometric_pop(image, moments.target, *common, moments=moments)

    def terms(self, image: Tensor, index: int, step: int) -> dict[str, float]:
        """Return the unweighted terms by name: l1 or l2, and d_ssim."""
        config, moments, mask = self._config, self._moments(index), self._views[index].mask
        kind, _ = config.photometric_at(step)
        pixelwise = losses.l1 if kind == "l1" else losses.l2
        compared = (image, moments.target, config.ssim_padding, mask, config.d_ssim_halved, moments)
        structural = self._losses.d_ssim(*compared)
        return {kind: float(pixelwise(image, moments.target, mask)), "d_ssim": float(structural)}

    def _moments(self, index: int) -> TargetMoments:
        if index in self._kept:
            return self._kept[index]
        moments = target_moments(self._views[index].target(), self._config.ssim_padding)
        needed = sum(t.numel() * t.element_size() for t in (moments.target, moments.mu_y, moments.s_yy))
        if needed <= self._room:
            self._room -= needed
            self._kept[index] = moments
        return moments


def _losses_of(backend: str) -> ModuleType:
    if backend != "compiled":
        return losses
    from pop_fast.compiled import losses as compiled

    return compiled
