"""What a user imports: `rasterization()` with gsplat's signature, and the backends that it can render with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.api.registry import BACKENDS, backend_names, get_backend
from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.api.rasterize import rasterization

__all__ = ["BACKENDS", "backend_names", "get_backend", "rasterization"]

# those of this package, as other packages declare theirs: none is imported before it is asked for
BACKENDS.register("fast", "pop_fast.stages.backend:FAST")
BACKENDS.register("compiled", "pop_fast.compiled.backend:COMPILED")
BACKENDS.register("cuda", "pop_fast.cuda.backend:CUDA")
BACKENDS.register("ref", "pop_fast.oracle.backend:REF")

# the names of backends are known without torch
__getattr__ = given_by(__name__, {"rasterize": ("rasterization",)})
