"""Tile lists cut into blocks of eight entries, and tiles in groups of similar list length.

Every operation of the blend runs over a group: a few hundred tiles, eight list entries, all pixels of a tile. Sorting
tiles by list length keeps the padding small, and lets the tiles whose lists have ended drop off the end of the group.
A block's entries lie side by side, so that a step gathers and scatters one stretch of memory a block, not one an entry.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.tiles import TileLists

BLOCK = 8  # list entries that are moved together, and blended per step where many tiles are
LONGEST = 4  # blocks that a step takes at most, where few are
PAIRS_PER_THREAD = 1 << 18  # (entry, pixel) pairs of a step: more than its overhead, and little enough for the caches


@dataclass(frozen=True)
class PackedLists:
    """Tile lists in which every tile begins a new block; the last block, and what is left of the others, is padding.

    Attributes:
        ids: splat of every entry, the number of splats for padding. [8 B] int64
        block_tiles: tile of every block. [B] int64
        first_blocks: each tile's first block. [tiles]
        n_blocks: each tile's number of blocks. [tiles]
        tile_size: px.
        tiles_x: tiles in a row.
    """

    ids: Tensor
    block_tiles: Tensor
    first_blocks: Tensor
    n_blocks: Tensor
    tile_size: int
    tiles_x: int

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
    """Some tiles, longest list first.

    Attributes:
        tiles: tile numbers. [G]
        first_blocks: number of each tile's first block. [G]
        n_blocks: blocks of each tile's list, descending. [G]
        reached: for each block of the lists, how many tiles' lists reach it.
        null_block: number of a block of padding.
        n_pixels: of a tile.
    """

    tiles: Tensor
    first_blocks: Tensor
    n_blocks: Tensor
    reached: list[int]
    null_block: int
    n_pixels: int

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
            n: how many of them take part, from the first.
            start: block of the lists where the step begins.
            count: blocks that it takes.

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
