"""The CUDA kernels of `cuda_ext` behind this program: `rasterization()` for those who choose its kernels, and stages.

Those who choose are benchmarks and the laws of each kernel. Importing this package needs neither kernels nor a GPU.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from pop_fast.api.backends import CUDA
from pop_fast.api.rasterize import rasterization as on_every_backend

if TYPE_CHECKING:
    from torch import Tensor

    from pop_fast.api.rasterize import RenderMeta


@functools.wraps(on_every_backend)
def rasterization(
    *args: Any,
    backward: Literal["pixel_parallel", "gaussian_parallel"] = "pixel_parallel",
    deterministic: bool = True,
    **kwargs: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render; see `pop_fast.api.rasterize.rasterization`.

    Args:
        backward, deterministic: as `pop_fast.api.backends.CudaBackend` says.
    """
    return on_every_backend(*args, **kwargs, backend=replace(CUDA, backward=backward, deterministic=deterministic))
