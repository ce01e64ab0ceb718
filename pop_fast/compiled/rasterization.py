"""`rasterization()` with the compiled stages: `pop_fast.rasterization.rasterization` with backend="compiled"."""

from __future__ import annotations

from functools import partial

from pop_fast import rasterization as on_cpus

rasterization = partial(on_cpus.rasterization, backend="compiled")
