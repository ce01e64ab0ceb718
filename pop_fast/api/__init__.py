"""What a user imports: `rasterization()` with gsplat's signature, and the backends that it can render with."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pop_fast.lazy import given_by

if TYPE_CHECKING:
    from pop_fast.api.rasterize import rasterization
    from pop_fast.api.registry import backend_names, get_backend

__all__ = ["backend_names", "get_backend", "rasterization"]

# the names of backends are known without torch
__getattr__ = given_by(__name__, {"rasterize": ("rasterization",), "registry": ("backend_names", "get_backend")})
