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
PAIRS_PER_SLAB = (
    1 << 19
)  # (entry, pixel) pairs of one step: enough to share among threads, small enough for their caches


@dataclass(frozen=True)
class TileGroup:
    """Some tiles, longest list first.

    Attributes:
        tiles: tile numbers. [G]
        lengths: list length of each tile, descending. [G]
        slots: entry number by tile and place in the list, padded with the null entry. [G, L], L a multiple of CHUNK
        reached: for each chunk of the lists, how many tiles' lists reach it.
        n_pixels: of a tile.
    """

    tiles: Tensor
    lengths: Tensor
    slots: Tensor
    reached: list[int]
    n_pixels: int

    @property
    def slab(self) -> int:
        """Return how many pairs a step has at most."""
        return len(self.tiles) * CHUNK * self.n_pixels

    def step_length(self, start: int, n: int) -> int:
        """Return how many entries the step from `start` takes when `n` tiles take part, a multiple of CHUNK.

        Few tiles take longer steps, so that the overhead of a step has pairs to be spread over.
        """
        left = self.slots.shape[1] - start
        return min(left, CHUNK * max(1, min(LONGEST, len(self.tiles) // (2 * n))))


def tile_groups(lists: TileLists) -> list[TileGroup]:
    """Group the tiles whose lists are not empty."""
    lengths, order = torch.sort(lists.lengths, descending=True, stable=True)
    n_filled = int((lengths > 0).sum())
    n_pixels = lists.tile_size**2
    size = max(1, PAIRS_PER_SLAB // (CHUNK * n_pixels))
    parts = zip(order[:n_filled].split(size), lengths[:n_filled].split(size), strict=True)
    return [_group(tiles, of_tiles, lists, n_pixels) for tiles, of_tiles in parts if len(tiles)]


def _group(tiles: Tensor, lengths: Tensor, lists: TileLists, n_pixels: int) -> TileGroup:
    n_chunks = -(-int(lengths[0]) // CHUNK)
    place = torch.arange(n_chunks * CHUNK)
    real = place < lengths[:, None]
    slots = torch.where(real, lists.offsets[tiles][:, None] + place, len(lists.ids))
    starts = torch.arange(n_chunks) * CHUNK
    reached = (lengths[:, None] > starts).sum(0).tolist()
    return TileGroup(tiles, lengths, slots, reached, n_pixels)
