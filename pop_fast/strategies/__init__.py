"""Population strategies, compatible with gsplat's protocol: how the number of Gaussians grows and shrinks."""

from __future__ import annotations

from pop_fast.strategies.base import StepEvent, Strategy
from pop_fast.strategies.control import DensityControl
from pop_fast.strategies.gsplat import GsplatStrategy, InriaStrategy
from pop_fast.strategies.pop import POPStrategy

__all__ = ["DensityControl", "GsplatStrategy", "InriaStrategy", "POPStrategy", "StepEvent", "Strategy"]
