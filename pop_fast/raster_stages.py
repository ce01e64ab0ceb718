"""The stages of a render that a CPU backend may have its own of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from pop_fast.backends import require_backend
from pop_fast.compositing import Composite, composite
from pop_fast.splatting import Splats, colors_of_view, covariances, project
from pop_fast.tiles import TileLists, tile_lists


@dataclass(frozen=True)
class Stages:
    """Functions with the signatures and results of the torch path's, which are the defaults.

    Attributes:
        covariances: as `pop_fast.splatting.covariances`.
        project: as `pop_fast.splatting.project`.
        colors_of_view: as `pop_fast.splatting.colors_of_view`.
        tile_lists: as `pop_fast.tiles.tile_lists`.
        composite: as `pop_fast.compositing.composite`.
    """

    covariances: Callable[..., Tensor] = covariances
    project: Callable[..., Splats] = project
    colors_of_view: Callable[..., Tensor] = colors_of_view
    tile_lists: Callable[..., TileLists] = tile_lists
    composite: Callable[..., Composite] = composite


def stages_of(backend: str) -> Stages:
    """Return the stages of backend "fast" or "compiled".

    Raises:
        PopError: the backend cannot run here; says why and what to do.
    """
    if backend == "fast":
        return Stages()
    require_backend(backend)
    from pop_fast.compiled.compositing import composite
    from pop_fast.compiled.splatting import colors_of_view, covariances, project
    from pop_fast.compiled.tiles import tile_lists

    return Stages(covariances, project, colors_of_view, tile_lists, composite)
