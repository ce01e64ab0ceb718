"""Density control with opacity reset: gsplat's default strategy, and Inria's 3DGS, which other methods are built on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pop_fast.density.control import DensityControl
from pop_ref.recipes import RECIPES, Recipe

_GSPLAT: Final[Recipe] = RECIPES["gsplat"]


@dataclass(frozen=True, kw_only=True)
class GsplatStrategy(DensityControl):
    """Growth by gradient alone, and opacity reset at steps 3000, 6000, 9000 and 12000.

    The defaults are those of gsplat's main since August 2025: 1.1 to 1.5.2 reset at step 0 as well (`reset_at_zero`),
    and 1.5.3 never, by a slip of operator precedence.
    """

    reset_every: int = _GSPLAT.density.reset_every
    prune_too_big: bool = _GSPLAT.density.prune_too_big
    blur_stop_iter: int = _GSPLAT.density.blur_stop_iter
    lambda_pop: float = _GSPLAT.lambda_pop


@dataclass(frozen=True, kw_only=True)
class InriaStrategy(GsplatStrategy):
    """The same as Inria's code has it: a gradient at the threshold grows, and a step that edits the Gaussians moves
    nothing."""

    inclusive: bool = RECIPES["3DGS"].density.inclusive
    edits_replace_update: bool = RECIPES["3DGS"].updates.edits_replace_update


@dataclass(frozen=True, kw_only=True)
class Inria2023Strategy(InriaStrategy):
    """The same as before October 2024, with opacities that move twice as fast, which is up to a learning rate."""
