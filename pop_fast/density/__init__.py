"""Density strategies, compatible with gsplat's protocol: how the number of Gaussians grows and shrinks."""

from __future__ import annotations

from pop_fast.density.control import DensityControl
from pop_fast.density.gsplat import GsplatStrategy, Inria2023Strategy, InriaStrategy
from pop_fast.density.mini_splatting import MiniSplattingStrategy
from pop_fast.density.pop import POPStrategy
from pop_fast.density.protocol import DensificationStep, Strategy
from pop_fast.density.pup import PupStrategy
from pop_fast.density.speedy_splat import SpeedySplatStrategy
from pop_fast.density.taming import TamingStrategy

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
