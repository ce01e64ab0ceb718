"""`rasterization()` with the compiled stages: `pop_fast.api.rasterize.rasterization` with backend="compiled"."""

from __future__ import annotations

from functools import partial

from pop_fast.api import rasterize as on_cpus

rasterization = partial(on_cpus.rasterization, backend="compiled")
