"""What a user imports: `rasterization()` with gsplat's signature, and the backends that it can render with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.api.backend import BACKENDS, backend_names, get_backend
from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.api.rasterize import rasterization

__all__ = ["BACKENDS", "backend_names", "get_backend", "rasterization"]

# those of this package, as other packages declare theirs: none is imported before it is asked for
BACKENDS.register("fast", "pop_fast.api.backends:FAST")
BACKENDS.register("compiled", "pop_fast.api.backends:COMPILED")
BACKENDS.register("cuda", "pop_fast.api.backends:CUDA")
BACKENDS.register("ref", "pop_fast.api.backends:REF")

# the names of backends are known without torch
__getattr__ = given_by(__name__, {"rasterize": ("rasterization",)})
