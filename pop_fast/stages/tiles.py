"""Which splats each tile blends, front to back (D3, D4). Meaning: `pop_ref.tiles`.

The exact lists of SnugBox and AccuTile (`pop_ref.tight_tiles`) are here too. The renderers list by the tiles' pixel
centres instead (`tile_lists` with conics and opacities), which leaves out more, but for a slack against rounding.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.types import columns, from_columns
from pop_ref.constants import PAPER, Profile

# what the test of a tile allows for rounding, of the exponent and of the terms that cancel in it: needles cancel;
# cuda_ext/csrc/tiles.cuh has the same two numbers, for the compiled lists and those of the GPU
SLACK, SLACK_SHARE = 1e-3, 1e-5
_RADIX = 1 << 15  # integers from which torch sorts by digits, up to six times faster than it sorts fewer


@dataclass(frozen=True)
class TileLists:
    """The lists of all tiles, one after the other."""

    ids: Tensor  # row of the splat of every entry; front to back within a tile, tiles in row-major order. [I] int64
    offsets: Tensor  # where each tile's list begins, and the end of the last one. [tiles_x * tiles_y + 1] int64
    tile_size: int  # px
    tiles_x: int  # tiles in a row
    tiles_y: int  # rows of tiles

    @classmethod
    def of(cls, lists: Sequence[Sequence[int]], width: int, height: int, tile_size: int) -> TileLists:
        """Take over the oracle's lists: ids front to back, one list a tile, row-major."""
        lengths = torch.tensor([0, *map(len, lists)])
        ids = torch.tensor([i for tile in lists for i in tile], dtype=torch.int64)
        return cls(ids, lengths.cumsum(0), tile_size, *grid_size(width, height, tile_size))

    @property
    def lengths(self) -> Tensor:
        """Return the number of entries of every tile. [tiles_x * tiles_y] int64"""
        return self.offsets.diff()

    @property
    def entry_tiles(self) -> Tensor:
        """Return the tile of every entry. [I] int64"""
        return torch.repeat_interleave(self.lengths)


def grid_size(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """See `pop_ref.tiles.grid_size`."""
    return -(-width // tile_size), -(-height // tile_size)


def check_grid(lists: TileLists, width: int, height: int, tile_size: int) -> None:
    """Raise ValueError where lists are not those of a grid."""
    tiles = grid_size(width, height, tile_size)
    if (lists.tile_size, lists.tiles_x, lists.tiles_y) != (tile_size, *tiles):
        raise ValueError(
            f"the lists are of {lists.tiles_x} x {lists.tiles_y} tiles of {lists.tile_size} px; "
            f"{width} x {height} px in tiles of {tile_size} px are {tiles[0]} x {tiles[1]}"
        )


def tile_rects(
    means2d: Tensor, radii: Tensor, width: int, height: int, tile_size: int, profile: Profile = PAPER
) -> Tensor:
    """See `pop_ref.tiles.tile_rects` (D3). Optimizations: component rows, no branches."""
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    (x, y), (rx, ry) = columns(means2d), columns(radii)
    shown = (rx > 0) & (ry > 0)
    x0, x1 = _span(x, rx, tiles_x, tile_size, profile)
    y0, y1 = _span(y, ry, tiles_y, tile_size, profile)
    return from_columns([torch.where(shown, edge, 0.0).to(torch.int64) for edge in (x0, y0, x1, y1)], (4,))


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
    """See `pop_ref.tiles.tile_lists` (D3, D4).

    Optimizations: only visible splats are sorted, by the bits of their depths, which order positive floats as
    integers; entries are made in depth order, so that one stable sort by 16-bit tile number finishes the lists. With
    `conics` and `opacities`, entries whose ellipse of alpha >= alpha_floor misses every pixel centre of the tile are
    left out: shorter lists, the same image.
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    rects = tile_rects(means2d, radii, width, height, tile_size, profile)
    rows = listed_rows(rects, depths)
    left, top, right, bottom = (edge.index_select(0, rows) for edge in columns(rects))
    columns_of_tiles = right - left
    counts = columns_of_tiles * (bottom - top)
    # entry e is the k-th tile of its splat's rectangle
    splat = torch.repeat_interleave(counts)
    k = (torch.arange(len(splat)) - (counts.cumsum(0) - counts).index_select(0, splat)).to(torch.int32)
    per_row = columns_of_tiles.to(torch.int32).index_select(0, splat)
    # integers under 2^24, whose float32 quotient never rounds up to the next one
    exact = torch.float32 if tiles_x * tiles_y <= 2**24 else torch.float64
    row_of_rect = (k.to(exact) / per_row).to(torch.int32)
    tile_x = left.to(torch.int32).index_select(0, splat) + k - row_of_rect * per_row
    tile_y = top.to(torch.int32).index_select(0, splat) + row_of_rect
    if conics is not None and opacities is not None:
        # by way of the depth order, so that what is gathered for the entries is close together
        shapes = [t.index_select(0, rows) for t in (*columns(means2d), *columns(conics), opacities)]
        touched = _touches(shapes, splat, tile_x, tile_y, tile_size, profile).nonzero().squeeze(1)
        splat, tile_x, tile_y = (t.index_select(0, touched) for t in (splat, tile_x, tile_y))
    return sorted_by_tile(rows.index_select(0, splat), tile_y * tiles_x + tile_x, tile_size, tiles_x, tiles_y)


def sorted_by_tile(ids: Tensor, tile: Tensor, tile_size: int, tiles_x: int, tiles_y: int) -> TileLists:
    """Make lists of entries that come front to back.

    Args:
        ids: splat of every entry. [I]
        tile: of every entry. [I] int32
        tile_size: px.
        tiles_x: tiles in a row.
        tiles_y: rows of tiles.
    """
    n_tiles = tiles_x * tiles_y
    order = _stable_order(tile.to(torch.int16 if n_tiles < 2**15 else torch.int32))
    offsets = torch.zeros(n_tiles + 1, dtype=torch.int64)
    torch.cumsum(torch.bincount(tile, minlength=n_tiles), 0, out=offsets[1:])
    return TileLists(ids.index_select(0, order), offsets, tile_size, tiles_x, tiles_y)


def _span(center: Tensor, radius: Tensor, n_tiles: int, tile_size: int, profile: Profile) -> tuple[Tensor, Tensor]:
    if profile.extent == "square":
        index = center - 0.5
        first = torch.trunc((index - radius) / tile_size)
        last = torch.trunc((index + radius + (tile_size - 1)) / tile_size)
    else:
        first = torch.floor((center - radius) / tile_size)
        last = torch.ceil((center + radius) / tile_size)
    return first.clamp(0, n_tiles), last.clamp(0, n_tiles)


def listed_rows(rects: Tensor, depths: Tensor) -> Tensor:
    """Return the rows of the splats whose rectangles [N, 4] hold tiles, front to back. [M] int64"""
    x0, y0, x1, y1 = columns(rects)
    rows = ((x1 > x0) & (y1 > y0)).nonzero().squeeze(1)
    return rows.index_select(0, depth_order(depths.index_select(0, rows)))


def depth_order(depths: Tensor) -> Tensor:
    """Return the order of positive depths, front to back; equal ones keep theirs (D4). [N] int64"""
    return _stable_order(depths.contiguous().view(torch.int32 if depths.dtype == torch.float32 else torch.int64))


def _stable_order(keys: Tensor) -> Tensor:
    n = len(keys)
    if _RADIX // 8 < n < _RADIX:
        # padding stays behind, as the sort is stable
        padded = keys.new_full((_RADIX,), torch.iinfo(keys.dtype).max)
        padded[:n] = keys
        keys = padded
    return torch.sort(keys, stable=True).indices[:n]


def _touches(
    shapes: list[Tensor], splat: Tensor, tile_x: Tensor, tile_y: Tensor, tile_size: int, profile: Profile
) -> Tensor:
    """Tell for each entry whether some pixel centre of the tile may reach alpha >= alpha_floor; errs towards True.

    sigma is convex, so its smallest value over the rectangle of pixel centres is 0 at an inside centre, and else lies
    on one of the two edges that face the centre, where it is a parabola.
    """
    x, y, a, b, c, limit = (t.index_select(0, splat) for t in (*shapes[:5], torch.log(shapes[5] / profile.alpha_floor)))
    left = (tile_x * tile_size).to(x.dtype) + 0.5 - x
    top = (tile_y * tile_size).to(x.dtype) + 0.5 - y
    right, bottom = left + (tile_size - 1), top + (tile_size - 1)
    edge_x = torch.minimum(torch.maximum(left, torch.zeros_like(left)), right)
    edge_y = torch.minimum(torch.maximum(top, torch.zeros_like(top)), bottom)
    along_y = torch.minimum(torch.maximum(-b * edge_x / c, top), bottom)
    along_x = torch.minimum(torch.maximum(-b * edge_y / a, left), right)
    vertical, size_v = _sigma_and_size(a, b, c, edge_x, along_y)
    horizontal, size_h = _sigma_and_size(a, b, c, along_x, edge_y)
    slack = SLACK + SLACK_SHARE * torch.maximum(size_v, size_h)
    # what overflowed on the way is not a number, and listed
    return ~(torch.minimum(vertical, horizontal) > limit + slack)


def _sigma_and_size(a: Tensor, b: Tensor, c: Tensor, dx: Tensor, dy: Tensor) -> tuple[Tensor, Tensor]:
    size = 0.5 * (a * dx * dx + c * dy * dy)
    return size + b * dx * dy, size


def snug_box(
    mean2d: Tensor, conic: Tensor, opacity: float, profile: Profile = PAPER
) -> tuple[float, float, float, float] | None:
    """See `pop_ref.tight_tiles.snug_box`."""
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
    rows = listed_rows(rects, depths)
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
