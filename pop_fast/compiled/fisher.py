"""Second moments of a view's derivatives, by the compiled library. Meaning: `pop_ref.fisher`."""

from __future__ import annotations

from torch import Tensor

from pop_fast.compiled.library import MomentScores
from pop_fast.compiled.scores import totals
from pop_fast.compiled.splatting import colors_of_view, covariances, project
from pop_fast.stages.blend.pairs import background_or_black, check_grid
from pop_fast.stages.fisher import N_MOMENTS, three_channels
from pop_fast.stages.fisher import fisher_blocks as fisher_blocks_of_stages
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile


def screen_moments(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.fisher.screen_moments`. [N, 31] float64

    Optimizations: those of `pop_fast.stages.fisher.screen_moments`, in C++, there and back (`scores.h`).

    Raises:
        ValueError: there are not three channels, or the lists are not of that grid.
    """
    check_grid(lists, width, height, tile_size)
    colors = three_channels(splats)
    behind = background_or_black(background, colors)
    return totals(MomentScores, N_MOMENTS, splats, colors, lists, (width, height), profile, background=behind)


def fisher_blocks(
    gaussians: Gaussians, camera: Camera, moments: Tensor, sh_degree: int | None = None, profile: Profile = PAPER
) -> Tensor:
    """See `pop_ref.fisher.fisher_blocks`. [N, 6, 6] Optimizations: the compiled stages' transposes."""
    chain = {"project": project, "colors_of_view": colors_of_view, "covariances": covariances}
    return fisher_blocks_of_stages(gaussians, camera, moments, sh_degree, profile, **chain)
