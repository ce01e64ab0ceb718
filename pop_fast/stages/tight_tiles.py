"""Exact tile lists: SnugBox and AccuTile. Meaning: `pop_ref.tight_tiles`.

The renderers list by the tiles' pixel centres instead (`tiles.tile_lists` with conics and opacities), which leaves out
more, but for a slack against rounding.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pop_fast.stages.layout import columns
from pop_fast.stages.tiles import TileLists, depth_order, grid_size, sorted_by_tile, tile_rects
from pop_ref.constants import PAPER, Profile


def snug_box(
    mean2d: Tensor, conic: Tensor, opacity: float, profile: Profile = PAPER
) -> tuple[float, float, float, float] | None:
    """See `pop_ref.tight_tiles.snug_box`. Optimizations: none."""
    if opacity < profile.alpha_floor:
        return None
    t = 2.0 * math.log(opacity / profile.alpha_floor)
    (u, v), (A, B, C) = mean2d.tolist(), conic.tolist()
    det = A * C - B * B
    half_x, half_y = math.sqrt(t * C / det), math.sqrt(t * A / det)
    return u - half_x, v - half_y, u + half_x, v + half_y


def accutile(
    mean2d: Tensor,
    conic: Tensor,
    opacity: float,
    rect: tuple[int, int, int, int],
    tile_size: int,
    profile: Profile = PAPER,
) -> list[tuple[int, int]]:
    """See `pop_ref.tight_tiles.accutile`. Optimizations: all rows at once."""
    opacities = torch.tensor([opacity]).to(mean2d)
    _, x, y = _met_tiles(mean2d[None], conic[None], opacities, torch.tensor([rect]), tile_size, profile)
    return list(zip(x.tolist(), y.tolist(), strict=True))


def tight_tile_lists(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    radii: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
) -> TileLists:
    """See `pop_ref.tight_tiles.tight_tile_lists` (D3, D4).

    Optimizations: all rows of all splats at once; entries are made in depth order, so that one stable sort by tile
    finishes the lists.
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    rects = tile_rects(means2d, radii, width, height, tile_size, profile)
    listed = ((rects[:, 2] > rects[:, 0]) & (rects[:, 3] > rects[:, 1])).nonzero().squeeze(1)
    rows = listed.index_select(0, depth_order(depths.index_select(0, listed)))
    means2d, conics, opacities, rects = (t.index_select(0, rows) for t in (means2d, conics, opacities, rects))
    splat, x, y = _met_tiles(means2d, conics, opacities, rects, tile_size, profile)
    tile = (y * tiles_x + x).to(torch.int32)
    return sorted_by_tile(rows.index_select(0, splat), tile, tile_size, tiles_x, tiles_y)


def _met_tiles(
    means2d: Tensor, conics: Tensor, opacities: Tensor, rects: Tensor, tile_size: int, profile: Profile
) -> tuple[Tensor, Tensor, Tensor]:
    """Return splat, column and row of every tile of the splats' rectangles that their ellipses meet, splat by splat."""
    x0, y0, x1, y1 = columns(rects)
    heights = torch.where(opacities >= profile.alpha_floor, y1 - y0, 0)
    splat, y = _places(heights)
    y += y0.index_select(0, splat)
    u, v = (t.index_select(0, splat) for t in columns(means2d))
    A, B, C = (t.index_select(0, splat) for t in columns(conics))
    t = 2.0 * torch.log(opacities.index_select(0, splat) / profile.alpha_floor)
    det = A * C - B * B
    # heights, within the row, nearest to those of the ellipse's leftmost and rightmost points
    top, bottom = y * tile_size - v, (y + 1) * tile_size - v
    half_y = torch.sqrt(t * A / det)
    low, high = torch.maximum(top, -half_y), torch.minimum(bottom, half_y)
    at_right = -B * torch.sqrt(t / (C * det))
    dy_left, dy_right = (torch.minimum(torch.maximum(at, low), high) for at in (-at_right, at_right))
    left = (-B * dy_left - torch.sqrt((A * t - det * dy_left * dy_left).clamp_min(0.0))) / A
    right = (-B * dy_right + torch.sqrt((A * t - det * dy_right * dy_right).clamp_min(0.0))) / A
    # far outside of any image where a needle overflowed on the way
    edges = (torch.floor((u + left) / tile_size), torch.ceil((u + right) / tile_size))
    first, last = (edge.nan_to_num().clamp(-1e9, 1e9).to(torch.int64) for edge in edges)
    first_x, last_x = x0.index_select(0, splat), x1.index_select(0, splat)
    # what rounding left without an ellipse gets its whole rectangle
    whole = ~(det > 0.0)
    begin = torch.where(whole, first_x, torch.maximum(first, first_x))
    end = torch.where(whole, last_x, torch.minimum(last, last_x))
    met = whole | ((half_y > top) & (-half_y < bottom))
    row, x = _places(torch.where(met, end - begin, 0).clamp_min(0))
    return splat.index_select(0, row), x + begin.index_select(0, row), y.index_select(0, row)


def _places(counts: Tensor) -> tuple[Tensor, Tensor]:
    """Return, of counts[i] entries for every i, to which i each belongs and its place among these."""
    owner = torch.repeat_interleave(counts)
    return owner, torch.arange(len(owner)) - (counts.cumsum(0) - counts).index_select(0, owner)
