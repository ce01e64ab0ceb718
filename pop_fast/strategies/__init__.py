"""Population strategies, compatible with gsplat's protocol: how the number of Gaussians grows and shrinks."""

from __future__ import annotations

from pop_fast.strategies.base import StepEvent, Strategy
from pop_fast.strategies.control import DensityControl
from pop_fast.strategies.gsplat import GsplatStrategy, Inria2023Strategy, InriaStrategy
from pop_fast.strategies.mini_splatting import MiniSplattingStrategy
from pop_fast.strategies.pop import POPStrategy
from pop_fast.strategies.pup import PupStrategy
from pop_fast.strategies.speedy_splat import SpeedySplatStrategy
from pop_fast.strategies.taming import TamingStrategy

__all__ = [
    "DensityControl",
    "GsplatStrategy",
    "Inria2023Strategy",
    "InriaStrategy",
    "MiniSplattingStrategy",
    "POPStrategy",
    "PupStrategy",
    "SpeedySplatStrategy",
    "StepEvent",
    "Strategy",
    "TamingStrategy",
]
