"""The photometric loss of a training view: (1 - lambda) L + lambda (1 - SSIM), with POP's L2 or 3DGS's L1 as L."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from pop_fast.losses import d_ssim, l1, l2
from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors


class Objective:
    """Compares renders with the photographs of the training views."""

    def __init__(self, config: TrainConfig, views: Sequence[ViewTensors]) -> None:
        self._kind = config.photometric_kind
        self._pixelwise = l1 if self._kind == "l1" else l2
        self._divisor = config.photometric_divisor
        self._weight = config.ssim_weight
        self._padding = config.ssim_padding
        self._views = views

    def __call__(self, image: Tensor, index: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a render of view `index`, and its unweighted terms by name."""
        view = self._views[index]
        target = view.target()
        pixelwise = self._pixelwise(image, target, view.mask)
        structural = d_ssim(image, target, self._padding, view.mask)
        loss = (1.0 - self._weight) / self._divisor * pixelwise + self._weight * structural
        return loss, {self._kind: pixelwise.detach(), "d_ssim": structural.detach()}
