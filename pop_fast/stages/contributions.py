"""What every Gaussian contributes to a view: sums over the pixels where it is blended. See `pop_ref.contributions`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.blend.pairs import EntryRows, PairWalk, check_grid
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import PAPER, Profile


@dataclass(frozen=True)
class Contributions:
    """Sums over the pixels where a Gaussian is blended; see `pop_ref.contributions.Contributions`.

    Attributes:
        weight_sum: of T alpha. [N] float64
        n_pixels: how many these are. [N] int64
        map_sum: of a map's values, 0 without a map. [N] float64
        distance_sum: of the distances of the pixels' centres to the splat's, px. [N] float64
    """

    weight_sum: Tensor
    n_pixels: Tensor
    map_sum: Tensor
    distance_sum: Tensor


def contributions(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Tensor | None = None,
    profile: Profile = PAPER,
) -> Contributions:
    """See `pop_ref.contributions.contributions`.

    Optimizations: a group of tiles and a block of list entries at a time (`pairs`).
    """
    check_grid(lists, width, height, tile_size)
    walk = PairWalk(splats, lists, width, height, profile)
    rows = EntryRows(walk, 4)
    given = checked_map(pixel_map, width, height, splats.means2d.dtype)
    values = walk.tiles_of(splats.means2d.new_zeros((height, width, 1)) if given is None else given[..., None])
    for pairs in walk.front_to_back():
        dx, dy = walk.offsets(pairs)
        weight = pairs.weight.sum(2)
        blended = torch.gt(pairs.alpha, 0.0, out=pairs.scratch)
        of_map = torch.bmm(blended, values.index_select(0, pairs.tiles).transpose(1, 2))[:, :, 0]
        distance = torch.hypot(dx, dy).mul_(blended).sum(2)
        rows.put(pairs, [weight, blended.sum(2), of_map, distance])
    weight_sum, n_pixels, map_sum, distance_sum = rows.totals().T
    return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)


def checked_map(pixel_map: Tensor | None, width: int, height: int, dtype: torch.dtype) -> Tensor | None:
    """Return a map in a precision.

    Raises:
        ValueError: it is not of the view's size.
    """
    if pixel_map is not None and pixel_map.shape != (height, width):
        raise ValueError(f"pixel_map has shape {list(pixel_map.shape)}; it must be [{height}, {width}]")
    return None if pixel_map is None else pixel_map.to(dtype)
