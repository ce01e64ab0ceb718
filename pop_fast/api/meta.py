"""The `meta` dict of `rasterization`, in which what costs another pass is computed when it is first read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.tiles import TileLists, tile_lists
from pop_ref.constants import Profile


class RenderMeta(dict[str, Any]):
    """A dict with some values still to be computed: reading one computes it, and all that come with it, once."""

    def __init__(self, ready: dict[str, Any]) -> None:
        super().__init__(ready)
        self._pending: dict[str, Callable[[], dict[str, Any]]] = {}

    def defer(self, keys: Iterable[str], compute: Callable[[], dict[str, Any]]) -> None:
        """Promise `keys`: `compute` returns all of them when one is read."""
        self._pending |= dict.fromkeys(keys, compute)

    def __missing__(self, key: str) -> Any:
        if key not in self._pending:
            raise KeyError(key)
        values = self._pending[key]()
        self.update(values)
        for name in values:
            self._pending.pop(name, None)
        return self[key]

    def __contains__(self, key: object) -> bool:
        return super().__contains__(key) or key in self._pending

    def __iter__(self) -> Iterator[str]:
        return iter((*super().__iter__(), *self._pending))

    def __len__(self) -> int:
        return super().__len__() + len(self._pending)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value, computing it if it is pending, or `default` when there is none."""
        if key not in self:
            return default
        return self[key]


def intersections(
    images: list[tuple[Tensor, Tensor, Tensor]],
    image_shape: tuple[int, ...],
    width: int,
    height: int,
    tile_size: int,
    profile: Profile,
) -> dict[str, Tensor]:
    """List tile overlaps as gsplat's meta does, from the extents alone (D3).

    Args:
        images: (means2d, radii, depths) of each image, one after the other in the flattened order.
        image_shape: batch dimensions and cameras.
        width: px.
        height: px.
        tile_size: px.
        profile: the kind of extent.

    Returns:
        tiles_per_gauss, isect_ids, flatten_ids, isect_offsets.
    """
    per_gauss: list[Tensor] = []
    ids: list[Tensor] = []
    flat: list[Tensor] = []
    offsets: list[Tensor] = []
    before, row = 0, 0
    for number, (means2d, radii, depths) in enumerate(images):
        lists = tile_lists(means2d, radii, depths, width, height, tile_size, profile)
        per_gauss.append(torch.bincount(lists.ids, minlength=len(depths)).to(torch.int32))
        ids.append(_isect_ids(lists, depths, number))
        flat.append((lists.ids + row).to(torch.int32))
        offsets.append((lists.offsets[:-1] + before).to(torch.int32))
        before += len(lists.ids)
        row += len(depths)
    tiles_x, tiles_y = -(-width // tile_size), -(-height // tile_size)
    return {
        "tiles_per_gauss": torch.cat(per_gauss),
        "isect_ids": torch.cat(ids),
        "flatten_ids": torch.cat(flat),
        "isect_offsets": torch.stack(offsets).reshape(*image_shape, tiles_y, tiles_x),
    }


def _isect_ids(lists: TileLists, depths: Tensor, image: int) -> Tensor:
    """Pack image, tile and the bits of the float32 depth into one integer, as gsplat sorts them."""
    tile_bits = math.floor(math.log2(lists.tiles_x * lists.tiles_y)) + 1
    bits = depths.detach().to(torch.float32).contiguous().view(torch.int32).to(torch.int64)[lists.ids]
    return (image << (32 + tile_bits)) | (lists.entry_tiles << 32) | bits
