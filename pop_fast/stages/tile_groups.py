"""Tile lists cut into blocks of eight entries, tiles in groups of similar list length, and the entries' exponents.

Every operation of the blend runs over a group: a few hundred tiles, eight list entries, all pixels of a tile. Sorting
tiles by list length keeps the padding small, and lets the tiles whose lists have ended drop off the end of the group.
A block's entries lie side by side, so that a step gathers and scatters one stretch of memory a block, not one an entry.

The exponent of alpha is a matrix product over a tile's pixels (meaning: `pop_ref.alpha`):

    alpha = o exp(-sigma) = 2^(f . p) with p = (1, x, y, x^2, xy, y^2) in pixels from the tile's centre

and six coefficients f per (splat, tile). The constant and linear coefficients cancel for needles whose centre is far
from the tile, so they are computed in float64 and rounded once; what is left within a tile is of the order of the
exponent itself. The transpose needs the same six moments of G = alpha dL/dalpha, M = sum_p G p. Moved from the tile's
centre to the splat's they can be added up over tiles, and every geometric gradient of the splat is linear in the sums.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import columns

BLOCK = 8  # list entries that are moved together, and blended per step where many tiles are
LONGEST = 4  # blocks that a step takes at most, where few are
PAIRS_PER_THREAD = 1 << 18  # (entry, pixel) pairs of a step: more than its overhead, and little enough for the caches


@dataclass(frozen=True)
class PackedLists:
    """Tile lists in which every tile begins a new block; the last block, and what is left of the others, is padding."""

    ids: Tensor  # splat of every entry, the number of splats for padding. [8 B] int64
    block_tiles: Tensor  # tile of every block. [B] int64
    first_blocks: Tensor  # each tile's first block. [tiles]
    n_blocks: Tensor  # each tile's number of blocks. [tiles]
    tile_size: int  # px
    tiles_x: int  # tiles in a row

    @classmethod
    def of(cls, lists: TileLists, n_splats: int) -> PackedLists:
        """Pack the lists."""
        n_blocks = (lists.lengths + (BLOCK - 1)) // BLOCK
        first_blocks = n_blocks.cumsum(0) - n_blocks
        tiles = torch.repeat_interleave(n_blocks)
        ids = torch.full((BLOCK * (len(tiles) + 1),), n_splats)
        moved = (BLOCK * first_blocks - lists.offsets[:-1]).index_select(0, lists.entry_tiles)
        ids.index_copy_(0, moved.add_(torch.arange(len(moved))), lists.ids)
        return cls(ids, torch.cat((tiles, tiles.new_zeros(1))), first_blocks, n_blocks, lists.tile_size, lists.tiles_x)


@dataclass(frozen=True)
class TileGroup:
    """Some tiles, longest list first."""

    tiles: Tensor  # tile numbers. [G]
    first_blocks: Tensor  # number of each tile's first block. [G]
    n_blocks: Tensor  # blocks of each tile's list, descending. [G]
    reached: list[int]  # for each block of the lists, how many tiles' lists reach it
    null_block: int  # number of a block of padding
    n_pixels: int  # of a tile

    @property
    def slab(self) -> int:
        """Return how many pairs a step has at most, with one more row a tile."""
        return len(self.tiles) * (BLOCK + 1) * self.n_pixels

    def step_blocks(self, start: int, n: int) -> int:
        """Return how many blocks of each list the step from block `start` takes when `n` tiles take part.

        Few tiles take longer steps, so that the overhead of a step has pairs to be spread over.
        """
        return min(len(self.reached) - start, max(1, min(LONGEST, len(self.tiles) // (2 * n))))

    def blocks(self, rows: Tensor | None, n: int, start: int, count: int) -> Tensor:
        """Return the blocks of a step, the null block where a list has ended.

        Args:
            rows: tiles to choose from, as places in the group; all when None.
            start: block of the lists where the step begins.

        Returns:
            [n, count]
        """
        chosen = slice(n) if rows is None else rows[:n]
        place = torch.arange(start, start + count)
        return torch.where(
            place < self.n_blocks[chosen, None], self.first_blocks[chosen, None] + place, self.null_block
        )


def tile_groups(lists: PackedLists) -> list[TileGroup]:
    """Group the tiles whose lists are not empty."""
    n_blocks, order = torch.sort(lists.n_blocks, descending=True, stable=True)
    n_filled, n_pixels = int((n_blocks > 0).sum()), lists.tile_size**2
    size = max(1, PAIRS_PER_THREAD * torch.get_num_threads() // (BLOCK * n_pixels))
    parts = zip(order[:n_filled].split(size), n_blocks[:n_filled].split(size), strict=True)
    return [_group(tiles, of_tiles, lists) for tiles, of_tiles in parts if len(tiles)]


def _group(tiles: Tensor, n_blocks: Tensor, lists: PackedLists) -> TileGroup:
    reached = (n_blocks[:, None] > torch.arange(int(n_blocks[0]))).sum(0).tolist()
    null_block = len(lists.block_tiles) - 1
    return TileGroup(tiles, lists.first_blocks[tiles], n_blocks, reached, null_block, lists.tile_size**2)


_LOG2_E = math.log2(math.e)
NULL_EXPONENT = -1e4  # 2 to this power is 0 in float32 and float64: entries that pad a list blend nothing


@dataclass(frozen=True)
class Entries:
    """What the pairs of one tile-list entry share, in float64, in the order of packed lists; padding has splat N."""

    lists: PackedLists  # the packed lists
    u: Tensor  # splat's centre from the tile's centre, px. [8 B]
    v: Tensor  # px. [8 B]

    @classmethod
    def of(cls, means2d: Tensor, lists: PackedLists) -> Entries:
        """Gather where each entry's splat is, seen from its tile."""
        x, y = (_with_padding(t, 0.0).index_select(0, lists.ids) for t in columns(means2d))
        size, tile = lists.tile_size, lists.block_tiles
        row = torch.div(tile, lists.tiles_x, rounding_mode="floor")
        x.view(-1, BLOCK).sub_((((tile - row * lists.tiles_x) * size).to(x.dtype) + 0.5 * size)[:, None])
        y.view(-1, BLOCK).sub_(((row * size).to(x.dtype) + 0.5 * size)[:, None])
        return cls(lists, x, y)


def exponent_coefficients(entries: Entries, conics: Tensor, opacities: Tensor) -> Tensor:
    """Return the six coefficients of log2(alpha) of every entry, such that padding blends nothing. [6, 8 B] float64

    Args:
        conics: inverse screen covariances, px^-2. [N, 3]
        opacities: [N]
    """
    u, v, ids = entries.u, entries.v, entries.lists.ids
    scaled = (_with_padding(t, 0.0).mul_(_LOG2_E) for t in columns(conics))
    a, b, c = (t.index_select(0, ids) for t in scaled)
    rows = torch.empty((6, len(ids)), dtype=torch.float64)
    constant, gx, gy = rows[0], rows[1], rows[2]
    torch.mul(a, u, out=gx).addcmul_(b, v)
    torch.mul(b, u, out=gy).addcmul_(c, v)
    torch.index_select(_with_padding(torch.log2(opacities.double()), NULL_EXPONENT), 0, ids, out=constant)
    constant.addcmul_(gx, u, value=-0.5).addcmul_(gy, v, value=-0.5)
    torch.mul(a, -0.5, out=rows[3])
    torch.neg(b, out=rows[4])
    torch.mul(c, -0.5, out=rows[5])
    return rows


def _with_padding(values: Tensor, padding: float) -> Tensor:
    """Return values as float64, with one more that padding takes. [N + 1]"""
    longer = torch.empty(len(values) + 1, dtype=torch.float64)
    longer[:-1], longer[-1] = values, padding
    return longer


def pixel_basis(tile_size: int, dtype: torch.dtype) -> Tensor:
    """Return (1, x, y, x^2, xy, y^2) at a tile's pixel centres, from its centre. [6, tile_size^2]"""
    at = torch.arange(tile_size, dtype=dtype) + (0.5 - 0.5 * tile_size)
    y, x = torch.meshgrid(at, at, indexing="ij")
    x, y = x.reshape(-1), y.reshape(-1)
    return torch.stack((torch.ones_like(x), x, y, x * x, x * y, y * y))


def centred_moments(entries: Entries, moments: Tensor) -> Tensor:
    """Turn the six moments of G about the tiles' centres ([6, 8 B]) into those about the splats' centres. float64"""
    u, v = entries.u, entries.v
    m0, mx, my, mxx, mxy, myy = found = moments.double()
    # about the splat's centre, with the signs of (splat - pixel); in place, so what is read last comes last
    du, dv = torch.mul(u, m0).sub_(mx), torch.mul(v, m0).sub_(my)
    mxx.addcmul_(u, du).addcmul_(u, mx, value=-1.0)
    mxy.addcmul_(u, dv).addcmul_(v, mx, value=-1.0)
    myy.addcmul_(v, dv).addcmul_(v, my, value=-1.0)
    mx.copy_(du)
    my.copy_(dv)
    return found


def splat_gradients(moments: Tensor, conics: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Turn each splat's centred moments ([6, N]) into gradients to screen centre, conic and opacity, component rows.

    Returns:
        [2, N], [3, N] and [N], float64.
    """
    a, b, c = (t.double() for t in columns(conics))
    m0, du, dv, duu, duv, dvv = moments
    centre = torch.stack((-(a * du + b * dv), -(b * du + c * dv)))
    # a splat without opacity blends nothing: its moment is 0
    return (
        centre,
        torch.stack((-0.5 * duu, -duv, -0.5 * dvv)),
        m0 / opacities.double().masked_fill(opacities == 0.0, 1.0),
    )
