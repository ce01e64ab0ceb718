"""The stages of a render that a CPU backend may have its own of."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.api.registry import require_backend
from pop_fast.stages.chord import DominantPoints, dominant_points
from pop_fast.stages.compositing import Composite, composite
from pop_fast.stages.contributions import Contributions, contributions
from pop_fast.stages.fisher import screen_moments
from pop_fast.stages.sensitivity import sensitivities
from pop_fast.stages.splatting import Splats, colors_of_view, covariances, project
from pop_fast.stages.tiles import TileLists, tile_lists

SMALL_TILE, LARGE_TILE = 8, 16  # px
SMALL_TILE_BELOW = 14.0  # px, root mean square extent of the visible splats; see benchmarks/NOTES.md


def torchs_tile(radii: Tensor) -> int:
    """Choose the tile that torch blends the cheapest, px; the image does not depend on it.

    Args:
        radii: extents of the splats, px, 0 where culled. [N, 2]
    """
    visible = (radii > 0).all(1)
    area = (radii * visible[:, None]).to(torch.float64).prod(1).sum() / visible.sum().clamp_min(1)
    return SMALL_TILE if math.sqrt(float(area)) < SMALL_TILE_BELOW else LARGE_TILE


def large_tile(radii: Tensor) -> int:
    """Return the tile whose rows are one vector of the compiled blend, px; it passes over rows that a splat misses."""
    return LARGE_TILE


@dataclass(frozen=True)
class Stages:
    """Functions with the signatures and results of the torch path's, which are the defaults.

    Attributes:
        covariances: as `pop_fast.stages.splatting.covariances`.
        project: as `pop_fast.stages.splatting.project`.
        colors_of_view: as `pop_fast.stages.splatting.colors_of_view`.
        tile_lists: as `pop_fast.stages.tiles.tile_lists`.
        composite: as `pop_fast.stages.compositing.composite`.
        blend_tile: given the splats' extents, the tile to blend them in.
        contributions: as `pop_fast.stages.contributions.contributions`.
        sensitivities: as `pop_fast.stages.sensitivity.sensitivities`.
        screen_moments: as `pop_fast.stages.fisher.screen_moments`.
        dominant_points: as `pop_fast.stages.chord.dominant_points`.
    """

    covariances: Callable[..., Tensor] = covariances
    project: Callable[..., Splats] = project
    colors_of_view: Callable[..., Tensor] = colors_of_view
    tile_lists: Callable[..., TileLists] = tile_lists
    composite: Callable[..., Composite] = composite
    blend_tile: Callable[[Tensor], int] = torchs_tile
    contributions: Callable[..., Contributions] = contributions
    sensitivities: Callable[..., Tensor] = sensitivities
    screen_moments: Callable[..., Tensor] = screen_moments
    dominant_points: Callable[..., DominantPoints] = dominant_points


def stages_of(backend: str) -> Stages:
    """Return the stages of backend "fast" or "compiled".

    Raises:
        PopError: the backend cannot run here; says why and what to do.
    """
    if backend == "fast":
        return Stages()
    require_backend(backend)
    from pop_fast.compiled.chord import dominant_points
    from pop_fast.compiled.compositing import composite
    from pop_fast.compiled.contributions import contributions
    from pop_fast.compiled.fisher import screen_moments
    from pop_fast.compiled.sensitivity import sensitivities
    from pop_fast.compiled.splatting import colors_of_view, covariances, project
    from pop_fast.compiled.tiles import tile_lists

    passes = (contributions, sensitivities, screen_moments, dominant_points)
    return Stages(covariances, project, colors_of_view, tile_lists, composite, large_tile, *passes)
