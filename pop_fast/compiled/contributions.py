"""What every Gaussian contributes to a view, by the compiled library. Meaning: `pop_ref.contributions`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.compiled.library import Scores
from pop_fast.compiled.scores import totals
from pop_fast.stages.blend.pairs import check_grid
from pop_fast.stages.contributions import Contributions, checked_map
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import PAPER, Profile


def contributions(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Tensor | None = None,
    profile: Profile = PAPER,
) -> Contributions:
    """See `pop_ref.contributions.contributions`. Optimizations: one blend without colours, in C++ (`scores.h`)."""
    check_grid(lists, width, height, tile_size)
    colors = splats.means2d.new_empty((len(splats.means2d), 0))
    pixel_map = checked_map(pixel_map, width, height, colors.dtype)
    found = totals(Scores, 4, splats, colors, lists, (width, height), profile, pixel_map=pixel_map)
    weight_sum, n_pixels, map_sum, distance_sum = found.T
    return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)
