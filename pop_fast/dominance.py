"""Dominant ids and counts (D8). Meaning: `pop_ref.dominance`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pop_fast.tile_groups import CHUNK

if TYPE_CHECKING:
    from pop_fast.blender import Chunk


def dominant_counts(dominant_ids: Tensor, n: int) -> Tensor:
    """See `pop_ref.dominance.dominant_counts`. Optimizations: one bincount."""
    return torch.bincount(dominant_ids.reshape(-1) + 1, minlength=n + 1)[1:]


class Dominance:
    """The running maximum of weights over a group's pixels, fed chunk by chunk, front to back (D8).

    Optimizations: the maximum over a chunk is a vectorised reduction; which chunk holds a pixel's maximum is kept as
    one number per pixel, and only that chunk's eight weights are searched, once, at the end.

    Attributes:
        weights: the largest weight so far. [G, P]
    """

    def __init__(self, like: Tensor) -> None:
        self.weights = torch.zeros_like(like)
        self._chunks = torch.full(like.shape, -1, dtype=torch.int32)

    def see(self, chunk: Chunk) -> None:
        """Take a chunk's weights into account."""
        largest = chunk.weight.amax(1)
        if chunk.rows is None:
            best, chunks = self.weights[: chunk.n], self._chunks[: chunk.n]
        else:
            best, chunks = self.weights[chunk.where], self._chunks[chunk.where]
        # strictly larger: on equal weights the chunk in front keeps the pixel
        chunks.masked_fill_(largest > best, chunk.index)
        torch.maximum(best, largest, out=best)
        if chunk.rows is not None:
            self.weights[chunk.where] = best
            self._chunks[chunk.where] = chunks

    def places(self, chunks: list[Chunk]) -> Tensor:
        """Return the place in its tile's list of each pixel's dominant entry, -1 where nothing was blended. [G, P]"""
        n_pixels = self.weights.shape[1]
        winners = self._chunks.view(-1)
        order = torch.sort(winners, stable=True).indices
        ends = torch.bincount(winners + 1, minlength=len(chunks) + 1).cumsum(0).tolist()
        pixels = order[ends[0] :]
        eights = self.weights.new_empty((len(pixels), CHUNK))
        of_eight = torch.arange(CHUNK) * n_pixels
        for chunk, start, end in zip(chunks, ends[:-1], ends[1:], strict=True):
            at = order[start:end]
            row = torch.div(at, n_pixels, rounding_mode="floor")
            first = at - row * n_pixels
            row = row if chunk.rows is None else torch.searchsorted(chunk.rows, row)
            first += row * (CHUNK * n_pixels)
            eights[start - ends[0] : end - ends[0]] = chunk.weight.view(-1)[first[:, None] + of_eight]
        places = torch.full(winners.shape, -1, dtype=torch.int64)
        # argmax takes the first of equal weights, which is the front one
        places[pixels] = eights.argmax(1) + winners[pixels] * CHUNK
        return places.view(self.weights.shape)
