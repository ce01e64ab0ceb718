"""The CUDA kernels of `cuda_ext` as a backend of this program."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.cuda.rasterize import rasterization

__all__ = ["rasterization"]

# whether there is a GPU is asked without torch
__getattr__ = given_by(__name__, {"rasterize": ("rasterization",)})
