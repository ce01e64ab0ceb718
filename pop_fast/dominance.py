"""Dominant ids and counts (D8). Meaning: `pop_ref.dominance`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pop_fast.tile_groups import CHUNK, TileGroup

if TYPE_CHECKING:
    from pop_fast.blender import GroupBlend


def dominant_counts(dominant_ids: Tensor, n: int) -> Tensor:
    """See `pop_ref.dominance.dominant_counts`. Optimizations: one bincount."""
    return torch.bincount(dominant_ids.reshape(-1) + 1, minlength=n + 1)[1:]


def dominant_places(group: TileGroup, blend: GroupBlend) -> tuple[Tensor, Tensor]:
    """Find the place in its tile's list, and the weight, of each pixel's dominant entry (D8).

    Optimizations: the maximum over a chunk is a vectorised reduction; which chunk holds a pixel's maximum is kept as
    one number per pixel, and only that chunk's eight weights are searched, once.

    Args:
        group: the tiles.
        blend: their blend, its chunks kept.

    Returns:
        Places, -1 where nothing was blended, and weights. Both [G, P].
    """
    best = torch.zeros_like(blend.image[:, 0])
    best_chunk = torch.full(best.shape, -1, dtype=torch.int32)
    for chunk in blend.chunks:
        where = chunk.where
        largest, before = chunk.weight.amax(1), best[where]
        # strictly larger: on equal weights the chunk in front keeps the pixel
        better = largest > before
        best[where] = torch.maximum(before, largest)
        best_chunk[where] = best_chunk[where].masked_fill_(better, chunk.index)
    places = torch.full(best.shape, -1, dtype=torch.int64)
    for chunk in blend.chunks:
        row, pixel = (best_chunk[chunk.where] == chunk.index).nonzero(as_tuple=True)
        # argmax takes the first of equal weights, which is the front one
        k = chunk.weight[row, :, pixel].argmax(1)
        row_in_group = row if chunk.rows is None else chunk.rows[row]
        places[row_in_group, pixel] = k + chunk.index * CHUNK
    return places, best
