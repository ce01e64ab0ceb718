"""How much a view's pixels react to every Gaussian's value there. See `pop_ref.sensitivity`."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from pop_fast.stages.blend.pairs import EntryRows, PairWalk, background_or_black, check_grid
from pop_fast.stages.splatting import Splats, colors_of
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import PAPER, Profile


def sensitivities(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.sensitivity.sensitivities`. [N] float64

    Optimizations: as the channels are added up before the square, one channel is blended, their sum; a group of tiles
    and a block of list entries at a time (`pairs`).
    """
    check_grid(lists, width, height, tile_size)
    grey = replace(splats, colors=colors_of(splats).sum(1, keepdim=True))
    walk = PairWalk(grey, lists, width, height, profile)
    rows = EntryRows(walk, 1)
    behind = background_or_black(background, colors_of(splats))
    for pairs, color_dot_grad in walk.color_dot_grads(behind.sum(0, keepdim=True)):
        # T = weight / alpha, and both are 0 where nothing is blended
        T = torch.div(pairs.weight, pairs.alpha.clamp_min_(torch.finfo(color_dot_grad.dtype).tiny), out=pairs.scratch)
        rows.put(pairs, [color_dot_grad[0].mul_(T).square_().sum(2)])
    return rows.totals()[:, 0] * splats.opacities.double().square()
