"""The losses that hold SSIM, by the compiled library; see `pop_fast.stages.losses` for each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from pop_fast.compiled.ssim import mean_dissimilarity
from pop_fast.stages import losses


def _by_the_library(loss: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def compiled(*args: Any, **kwargs: Any) -> Tensor:
        return loss(*args, dissimilarity=mean_dissimilarity, **kwargs)

    return compiled


ssim = _by_the_library(losses.ssim)
d_ssim = _by_the_library(losses.d_ssim)
photometric_3dgs = _by_the_library(losses.photometric_3dgs)
photometric_pop = _by_the_library(losses.photometric_pop)
