"""Tiles in groups of similar list length, their lists padded to rectangles.

Every operation of the blend runs over a group: a few hundred tiles, eight list entries, all pixels of a tile. Sorting
tiles by list length keeps the padding small, and lets the tiles whose lists have ended drop off the end of the group.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.tiles import TileLists

CHUNK = 8  # list entries blended per step
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
    """

    tiles: Tensor
    lengths: Tensor
    slots: Tensor
    reached: list[int]


def tile_groups(lists: TileLists) -> list[TileGroup]:
    """Group the tiles whose lists are not empty."""
    lengths, order = torch.sort(lists.lengths, descending=True, stable=True)
    n_filled = int((lengths > 0).sum())
    size = max(1, PAIRS_PER_SLAB // (CHUNK * lists.tile_size**2))
    null_entry = len(lists.ids)
    parts = zip(order[:n_filled].split(size), lengths[:n_filled].split(size), strict=True)
    return [_group(tiles, of_tiles, lists.offsets, null_entry) for tiles, of_tiles in parts if len(tiles)]


def _group(tiles: Tensor, lengths: Tensor, offsets: Tensor, null_entry: int) -> TileGroup:
    n_chunks = -(-int(lengths[0]) // CHUNK)
    place = torch.arange(n_chunks * CHUNK)
    real = place < lengths[:, None]
    slots = torch.where(real, offsets[tiles][:, None] + place, null_entry)
    starts = torch.arange(n_chunks) * CHUNK
    reached = (lengths[:, None] > starts).sum(0).tolist()
    return TileGroup(tiles, lengths, slots, reached)
