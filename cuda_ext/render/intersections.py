"""gsplat's overlap keys of meta, made when they are asked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cuda_ext.arrays import Settings
from cuda_ext.render.lists import make_lists, splat_struct


def intersections(settings: Settings, images: Sequence[Any]) -> dict[str, Any]:
    """List tile overlaps as gsplat's meta does, from the extents alone (D3).

    Args:
        settings: of the call; its tile size is the caller's.
        images: with means2d, depths, conics, opacities and radii, in the order of cameras.

    Returns:
        tiles_per_gauss, isect_ids, flatten_ids, isect_offsets.
    """
    size = settings.tile_size
    per_row: list[Tensor] = []
    ids: list[Tensor] = []
    flat: list[Tensor] = []
    offsets: list[Tensor] = []
    before, row = 0, 0
    for number, image in enumerate(images):
        splats = splat_struct(
            image.means2d.detach().contiguous(),
            image.depths.detach().contiguous(),
            image.conics.detach().contiguous(),
            image.opacities.detach().contiguous(),
            image.radii.contiguous(),
            None,
        )
        found = make_lists(settings, splats, len(image.depths), image.depths.device, (size, size), False)
        listed, begin, end = (found.tensor(name) for name in ("listed", "tile_begin", "tile_end"))
        lengths = (end - begin).long()
        tiles = torch.repeat_interleave(torch.arange(found.n_tiles, device=listed.device), lengths)
        bits = image.depths.detach().contiguous().view(torch.int32).long()[listed.long()]
        shift = 32 + math.floor(math.log2(found.n_tiles)) + 1
        per_row.append(torch.bincount(listed.long(), minlength=len(image.depths)).to(torch.int32))
        ids.append((number << shift) | (tiles << 32) | bits)
        flat.append((listed + row).to(torch.int32))
        offsets.append((lengths.cumsum(0) - lengths + before).to(torch.int32))
        before, row = before + len(listed), row + len(image.depths)
    shape = (len(images), -(-settings.height // size), -(-settings.width // size))
    return {
        "tiles_per_gauss": torch.cat(per_row),
        "isect_ids": torch.cat(ids),
        "flatten_ids": torch.cat(flat),
        "isect_offsets": torch.stack(offsets).reshape(shape),
    }
