"""Count what the blend's warps do: visits of splats by the quarters of their tiles, and batches of entries.

A warp goes through its tile's list in batches of 32. In each, a quarter of the tile (8 x 4 pixels, eight lanes) queues
up the splats that reach it, and the warp makes as many visits as the longest of its four queues has, four at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

BATCH, WORD, EIGHT = 32, 4, 8
FLOOR = 1.0 / 255.0


class Visits(NamedTuple):
    """What is made for a view."""

    visits: int  # of a splat a quarter, by a warp, rounded up to four in every batch
    eights: int  # eight visits or what is left of them in a batch, whose sums the backward pass adds up together
    batches: int  # of 32 entries of a list or what is left of it


def count_tried(means2d: Tensor, radii: Tensor, width: int, height: int) -> int:
    """Count the 16 x 8 tiles in the rectangles of splats, which are tried when lists are made."""
    tried = torch.ones(len(means2d), dtype=torch.long, device=means2d.device)
    for axis, (size, length) in enumerate(((16, width), (8, height))):
        center, radius, tiles = means2d[:, axis], radii[:, axis], -(-length // size)
        first, last = ((center - radius) / size).floor(), ((center + radius) / size).ceil()
        tried *= (last.clamp(0, tiles) - first.clamp(0, tiles)).long()
    return int(tried[(radii > 0).all(1)].sum())


def count_visits(lists: Any, splats: Mapping[str, Tensor], traversed: Tensor) -> Visits:
    """Count the visits of a view.

    Args:
        lists: `TileBuffers` of 16 x 8 tiles.
        splats: means2d, conics and opacities.
        traversed: entries that every pixel visits. [H, W]
    """
    height, width = traversed.shape
    across, down = -(-width // 16), -(-height // 8)
    walked = pad(traversed, (0, 16 * across - width, 0, 8 * down - height)).view(down, 2, 4, across, 2, 8)
    walked = walked.amax((2, 5)).permute(0, 2, 1, 3).reshape(-1, 4).long()
    begin, lengths = lists.tensor("tile_begin").long(), walked.amax(1)
    tile = torch.arange(len(lengths), device=begin.device).repeat_interleave(lengths)
    place = torch.arange(len(tile), device=tile.device) - (lengths.cumsum(0) - lengths)[tile]
    splat = lists.tensor("listed")[begin[tile] + place].long()
    corner = torch.stack((16 * (tile % across), 8 * (tile // across)), 1) + 0.5
    reached = _quarters_reached(corner, *(splats[name][splat] for name in ("means2d", "conics", "opacities")))
    reached &= place[:, None] < walked[tile]
    batches = (lengths + BATCH - 1) // BATCH
    batch = (batches.cumsum(0) - batches)[tile] + place // BATCH
    queues = torch.zeros((int(batches.sum()), 4), dtype=torch.long, device=tile.device)
    longest = queues.index_add(0, batch, reached.long()).amax(1)
    fours, eights = (int(((longest + size - 1) // size).sum()) for size in (WORD, EIGHT))
    return Visits(WORD * fours, eights, len(queues))


def _quarters_reached(corner: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    """Tell which quarters have a point where a splat reaches the floor, as csrc/quarters.cuh does. [entries, 4]"""
    A, B, C = conics.unbind(1)
    reach = torch.log(opacities / FLOOR) + 1e-3
    found: list[Tensor] = []
    for down in (0, 1):
        for across in (0, 1):
            right = means2d[:, 0] - corner[:, 0] - 8 * across
            low = means2d[:, 1] - corner[:, 1] - 4 * down
            left, high = right - 7, low - 3
            dx, dy = (torch.clamp(torch.zeros_like(a), a, b) for a, b in ((left, right), (high, low)))
            at_x, at_y = torch.clamp(-B * dy / A, left, right), torch.clamp(-B * dx / C, high, low)
            on_x, on_y = (0.5 * (A * x * x + C * y * y) + B * x * y for x, y in ((dx, at_y), (at_x, dy)))
            found.append(torch.minimum(on_x, on_y) <= reach)
    return torch.stack(found, 1)
