"""The `meta` of `rasterization`, in which what costs another pass is computed when it is first read."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableMapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor

from pop_fast.stages.tiles import TileLists


class RenderMeta(MutableMapping[str, Any]):
    """A mapping with some values still to be computed: reading one computes it, and all that come with it, once.

    `keys`, `in`, `len` and iteration compute nothing; `items`, `values`, `dict(meta)` and `**meta` compute everything.
    """

    def __init__(self, ready: Mapping[str, Any]) -> None:
        # a key has its place from the first, computed or not
        self._values: dict[str, Any] = dict(ready)
        self._pending: dict[str, Callable[[], Mapping[str, Any]]] = {}

    def defer(self, keys: Iterable[str], compute: Callable[[], Mapping[str, Any]]) -> None:
        """Promise `keys`: `compute` returns all of them when one is read. What is there already stays."""
        for key in keys:
            if key not in self._values:
                self._values[key], self._pending[key] = None, compute

    def __getitem__(self, key: str) -> Any:
        if key in self._pending:
            for name, value in self._pending[key]().items():
                # what has been set or computed meanwhile stays as it is
                if self._pending.pop(name, None) is not None:
                    self._values[name] = value
        return self._values[key]

    def __setitem__(self, key: str, value: Any) -> None:
        self._pending.pop(key, None)
        self._values[key] = value

    def __delitem__(self, key: str) -> None:
        self._pending.pop(key, None)
        del self._values[key]

    def __contains__(self, key: object) -> bool:
        return key in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __or__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return {**self, **other}

    def __ror__(self, other: Mapping[str, Any]) -> dict[str, Any]:
        return {**other, **self}

    def __ior__(self, other: Mapping[str, Any]) -> Self:
        self.update(other)
        return self

    def __repr__(self) -> str:
        return f"RenderMeta({list(self)}, to be computed when read: {list(self._pending)})"

    def changed(self, change: Callable[[Any], Any]) -> RenderMeta:
        """Return a mapping with the same keys, whose values are fetched from here, and changed, when they are read."""
        made = RenderMeta({})
        for key in self:
            made.defer((key,), lambda key=key: {key: change(self[key])})
        return made


def intersections(lists: Sequence[TileLists], depths: Sequence[Tensor], image_shape: tuple[int, ...]) -> dict[str, Any]:
    """Return tile overlaps as gsplat's meta has them, from the extents alone (D3).

    Args:
        lists: of every image's rows, one after the other in the flattened order.
        depths: of the rows. [M] each
        image_shape: batch dimensions and cameras.

    Returns:
        tiles_per_gauss, isect_ids, flatten_ids, isect_offsets.
    """
    per_gauss: list[Tensor] = []
    ids: list[Tensor] = []
    flat: list[Tensor] = []
    offsets: list[Tensor] = []
    before, row = 0, 0
    for number, (found, depth) in enumerate(zip(lists, depths, strict=True)):
        per_gauss.append(torch.bincount(found.ids, minlength=len(depth)).to(torch.int32))
        ids.append(_isect_ids(found, depth, number))
        flat.append((found.ids + row).to(torch.int32))
        offsets.append((found.offsets[:-1] + before).to(torch.int32))
        before += len(found.ids)
        row += len(depth)
    return {
        "tiles_per_gauss": torch.cat(per_gauss),
        "isect_ids": torch.cat(ids),
        "flatten_ids": torch.cat(flat),
        "isect_offsets": torch.stack(offsets).reshape(*image_shape, lists[0].tiles_y, lists[0].tiles_x),
    }


def _isect_ids(lists: TileLists, depths: Tensor, image: int) -> Tensor:
    """Pack image, tile and the bits of the float32 depth into one integer, as gsplat sorts them."""
    tile_bits = math.floor(math.log2(lists.tiles_x * lists.tiles_y)) + 1
    bits = depths.detach().to(torch.float32).contiguous().view(torch.int32).to(torch.int64)[lists.ids]
    return (image << (32 + tile_bits)) | (lists.entry_tiles << 32) | bits
