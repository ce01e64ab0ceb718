"""Density strategies, compatible with gsplat's protocol: how the number of Gaussians grows and shrinks."""

from __future__ import annotations

from pop_fast.density.control import DensityControl
from pop_fast.density.methods import (
    GsplatStrategy,
    Inria2023Strategy,
    InriaStrategy,
    MiniSplattingStrategy,
    POPStrategy,
    PupStrategy,
    SpeedySplatStrategy,
    TamingStrategy,
)
from pop_fast.density.protocol import DensificationStep, Strategy

__all__ = [
    "DensityControl",
    "GsplatStrategy",
    "Inria2023Strategy",
    "InriaStrategy",
    "MiniSplattingStrategy",
    "POPStrategy",
    "PupStrategy",
    "SpeedySplatStrategy",
    "DensificationStep",
    "Strategy",
    "TamingStrategy",
]
