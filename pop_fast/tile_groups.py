"""Tiles in groups of similar list length, their lists padded to rectangles.

Every operation of the blend runs over a group: a few hundred tiles, eight list entries, all pixels of a tile. Sorting
tiles by list length keeps the padding small, and lets the tiles whose lists have ended drop off the end of the group.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.tiles import TileLists

CHUNK = 8  # list entries blended per step, where many tiles are
LONGEST = 4  # chunks that a step takes at most, where few are
PAIRS_PER_THREAD = 1 << 18  # (entry, pixel) pairs of a step: more than its overhead, and little enough for the caches


@dataclass(frozen=True)
class TileGroup:
    """Some tiles, longest list first.

    Attributes:
        tiles: tile numbers. [G]
        firsts: number of each tile's first entry. [G]
        lengths: list length of each tile, descending. [G]
        reached: for each chunk of the lists, how many tiles' lists reach it.
        null_entry: number of the entry that blends nothing.
        n_pixels: of a tile.
    """

    tiles: Tensor
    firsts: Tensor
    lengths: Tensor
    reached: list[int]
    null_entry: int
    n_pixels: int

    @property
    def slab(self) -> int:
        """Return how many pairs a step has at most."""
        return len(self.tiles) * CHUNK * self.n_pixels

    def step_length(self, start: int, n: int) -> int:
        """Return how many entries the step from `start` takes when `n` tiles take part, a multiple of CHUNK.

        Few tiles take longer steps, so that the overhead of a step has pairs to be spread over.
        """
        left = len(self.reached) - start // CHUNK
        return CHUNK * min(left, max(1, min(LONGEST, len(self.tiles) // (2 * n))))

    def slots(self, rows: Tensor | None, n: int, start: int, length: int) -> Tensor:
        """Return the entry numbers of a step, the null entry where a list has ended.

        Args:
            rows: tiles to choose from, as places in the group; all when None.
            n: how many of them take part, from the first.
            start: place in the lists where the step begins.
            length: entries that it takes.

        Returns:
            [n, length]
        """
        chosen = slice(n) if rows is None else rows[:n]
        place = torch.arange(start, start + length)
        return torch.where(place < self.lengths[chosen, None], self.firsts[chosen, None] + place, self.null_entry)


def tile_groups(lists: TileLists) -> list[TileGroup]:
    """Group the tiles whose lists are not empty."""
    lengths, order = torch.sort(lists.lengths, descending=True, stable=True)
    n_filled, n_pixels = int((lengths > 0).sum()), lists.tile_size**2
    size = max(1, PAIRS_PER_THREAD * torch.get_num_threads() // (CHUNK * n_pixels))
    parts = zip(order[:n_filled].split(size), lengths[:n_filled].split(size), strict=True)
    return [_group(tiles, of_tiles, lists) for tiles, of_tiles in parts if len(tiles)]


def _group(tiles: Tensor, lengths: Tensor, lists: TileLists) -> TileGroup:
    starts = torch.arange(0, int(lengths[0]), CHUNK)
    reached = (lengths[:, None] > starts).sum(0).tolist()
    return TileGroup(tiles, lists.offsets[tiles], lengths, reached, len(lists.ids), lists.tile_size**2)
