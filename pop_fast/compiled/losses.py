"""D-SSIM with its gradient, and the losses that hold it, by the compiled library. Meaning: `pop_ref.ssim`.

See `pop_fast.stages.losses` for each loss.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pop_fast.compiled.library import call_library, this_library
from pop_fast.stages import losses
from pop_fast.stages.losses import REACH, TargetMoments, border_of, kept_windows


def mean_dissimilarity(
    difference: Tensor, moments: TargetMoments, mask: Tensor | None, weight: float | None
) -> tuple[Tensor, Tensor | None]:
    """See `pop_fast.stages.losses.mean_dissimilarity`.

    Optimizations: one pass from the difference to the derivatives by the windows' moments, and one from these to the
    gradient (`ssim.h`); what is blurred stays in the cache.
    """
    height, width, channels = difference.shape
    kept = None if mask is None else kept_windows(mask, moments.padding, channels, difference.dtype)
    n = moments.mu_y.numel() if kept is None else int(kept.sum())
    gradient = None if weight is None else torch.empty_like(difference, memory_format=torch.contiguous_format)
    if n == 0:
        return difference.new_zeros(()), None if gradient is None else gradient.zero_()
    library, line = this_library(), (width + REACH) * channels
    stride = library.padded_line(line, difference.element_size())
    totals = torch.empty(-(-len(moments.mu_y) // library.window_rows), dtype=torch.float64)
    partials = None if weight is None else difference.new_empty((3, height + REACH, stride))
    call_library(
        "ssim",
        difference.dtype,
        {"height": height, "width": width, "channels": channels, "border": border_of(moments.padding)}
        | {"stride": stride, "threads": torch.get_num_threads(), "weight": (weight or 0.0) / n},
        {"difference": difference, "target": moments.target, "mu_y": moments.mu_y, "s_yy": moments.s_yy}
        | {"kept": kept, "totals": totals, "partials": partials, "gradient": gradient},
    )
    return (totals.sum() / n).to(difference.dtype), gradient


def _by_the_library(loss: Callable[..., Tensor]) -> Callable[..., Tensor]:
    def compiled(*args: Any, **kwargs: Any) -> Tensor:
        return loss(*args, dissimilarity=mean_dissimilarity, **kwargs)

    return compiled


ssim = _by_the_library(losses.ssim)
d_ssim = _by_the_library(losses.d_ssim)
photometric_3dgs = _by_the_library(losses.photometric_3dgs)
photometric_pop = _by_the_library(losses.photometric_pop)
