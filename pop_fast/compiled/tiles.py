"""Tile lists by the compiled library. Meaning: `pop_ref.tiles`."""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.compiled.library import Lists, call_library
from pop_fast.stages.tiles import TileLists, depth_order, grid_size, tile_rects
from pop_ref.constants import PAPER, Profile


def tile_lists(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> TileLists:
    """See `pop_ref.tiles.tile_lists` (D3, D4), and `pop_fast.stages.tiles.tile_lists` for `conics` and `opacities`.

    Optimizations: rectangles and depth order are torch's; a counting sort by tile of entries that are made in depth
    order (`lists.h`).
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    rects = tile_rects(means2d, radii, width, height, tile_size, profile).T.contiguous()
    x0, y0, x1, y1 = rects
    rows = ((x1 > x0) & (y1 > y0)).nonzero().squeeze(1)
    order = rows.index_select(0, depth_order(depths.index_select(0, rows)))
    candidates = torch.zeros(len(order) + 1, dtype=torch.int64)
    torch.cumsum(((x1 - x0) * (y1 - y0)).index_select(0, order), 0, out=candidates[1:])
    n_candidates = int(candidates[-1])
    ids, tiles = torch.empty(n_candidates, dtype=torch.int64), torch.empty(n_candidates, dtype=torch.int32)
    offsets = torch.empty(tiles_x * tiles_y + 1, dtype=torch.int64)
    exact = {} if conics is None or opacities is None else {"conics": conics, "opacities": opacities}
    call_library(
        Lists,
        means2d.dtype,
        {"n": len(means2d), "m": len(order), "tiles_x": tiles_x, "tiles_y": tiles_y, "tile_size": tile_size}
        | {"threads": torch.get_num_threads(), "alpha_floor": profile.alpha_floor},
        {"means2d": means2d, **exact, "rects": rects, "order": order, "candidates": candidates}
        | {"tiles": tiles, "ids": ids, "offsets": offsets},
    )
    return TileLists(ids[: int(offsets[-1])], offsets, tile_size, tiles_x, tiles_y)
