"""Tile lists on the GPU: buffers, their growth, and what they say.

Sorts and ranges run over the capacity of a list and not over its length, because a captured step cannot ask for the
length. So the capacity follows the need: it grows when a step finds too little, and returns to `GROWTH` times the need
at every densification step, when buffers are made anew in any case. The need of an image size is the most that one of
its views had when last drawn. So the heaviest view counts even if the last window did not draw it, and a phase of large
splats is forgotten once every view has been drawn again. A capacity that is nearly right is kept, so that small changes
of the need neither move memory nor cause an overflow.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import (
    BAD_ROW,
    N_INSTANCES,
    NOT_BAD,
    CudaMemoryError,
    Settings,
    SideStream,
    empty,
    fill,
    new_state,
    stream_of,
)

WARP_TILE = (16, 8)  # px, what a warp blends
BUCKET = 32
ALIGNED = 256  # entries that an array begins at a multiple of, as the driver's own pieces of memory do
LOWER = "the number of Gaussians, their opacity extents or the image size"
# the kernels number instances by int, with some to spare for the threads behind the last one
MOST = 2**31 - 1024
GROWTH = 1.5
FIRST_GUESS = (8, 1024)  # instances a Gaussian, and at least
KEPT = (1.2, 2.0)  # times the need: a room within is left as it is
Size = tuple[int, int]


class TileBuffers:
    """The buffers behind the kernels' `TileLists`, for n splats, an image and a capacity of instances.

    Args:
        n: splats.
        width, height: px.
        tile: px, (width, height) of a list's tile.
        exact: leave out tiles that no pixel centre reaches.
        device: where.
        buckets: also number buckets of 32 entries, for backward "gaussian_parallel".
    """

    def __init__(
        self, n: int, width: int, height: int, tile: tuple[int, int], exact: bool, device: torch.device, buckets: bool
    ) -> None:
        self.n, self.device, self.tile, self.buckets = n, device, tile, buckets
        self.struct = load().TileLists()
        self.struct.n, self.struct.exact = n, exact
        self.struct.set_grid(width, height, *tile)
        self.n_tiles: int = self.struct.n_tiles
        self._kept: dict[str, Tensor] = {}
        self._allocate(n, "depth_keys", "depth_keys_sorted", "order_unsorted", "order", "splat_begin", "splat_count")
        if exact:
            self._allocate(load().hit_words(n), "hits")
        self._allocate(self.n_tiles, "tile_begin", "tile_end", "tile_order")
        self.capacity = -1
        self.reserve(0)

    def reserve(self, capacity: int) -> None:
        """Make room for at least that many instances; buffers only grow.

        Raises:
            CudaMemoryError: no room, or more entries than the kernels can number.
        """
        if capacity <= self.capacity:
            return
        if capacity > MOST:
            # a count stops at 2^31 - 1, so that it says "at least"
            raise CudaMemoryError(
                f"the tile lists would have {capacity:,} entries or more; the kernels number {MOST:,}: lower {LOWER}"
            )
        self.capacity = capacity
        self.struct.capacity = capacity
        keys = torch.int32 if self.n_tiles >= 0xFFFF else torch.int16
        self._allocate(capacity, "tile_keys", "tile_keys_sorted", dtype=keys)
        self._allocate(capacity, "slots_unsorted", "slots", "slot_splat", "listed")
        if self.buckets:
            self._allocate(self.n_tiles, "bucket_begin")
            self._allocate(self.max_buckets, "bucket_tile")
        bytes_needed = load().tile_workspace(self.n, capacity, self.n_tiles)
        self._allocate(bytes_needed, "workspace", dtype=torch.uint8)
        self.struct.workspace_bytes = bytes_needed

    @property
    def max_buckets(self) -> int:
        """Return how many buckets of 32 entries the capacity can make."""
        return self.capacity // BUCKET + self.n_tiles

    @property
    def parts(self) -> int:
        """Return how many warps share a list's tile, and so rows an instance's slot has."""
        return (self.tile[0] // WARP_TILE[0]) * (self.tile[1] // WARP_TILE[1])

    def tensor(self, name: str) -> Tensor:
        """Return a buffer by the kernels' name for it."""
        return self._kept[name]

    def _allocate(self, size: int, *names: str, dtype: torch.dtype = torch.int32) -> None:
        """Make room for arrays of one size, in one piece: asking for many small ones takes longer than to fill them."""
        pitch = -(-size // ALIGNED) * ALIGNED
        # what was there goes first: both at a time would be twice the memory
        for name in names:
            self._kept.pop(name, None)
        fill(self.struct, **dict.fromkeys(names))
        made = empty(f"the tile lists ({names[0]})", LOWER, (len(names), pitch), self.device, dtype)
        self._kept |= {name: made[k, :size] for k, name in enumerate(names)}
        fill(self.struct, **{name: self._kept[name] for name in names})


def splat_struct(
    means2d: Tensor, depths: Tensor, conics: Tensor, opacities: Tensor, radii: Tensor, colors: Tensor | None
) -> Any:
    """Return the kernels' view of projected Gaussians."""
    return fill(
        load().Splats(), means2d=means2d, depths=depths, conics=conics, opacities=opacities, radii=radii, colors=colors
    )


def list_tile(settings: Settings, counted: bool) -> tuple[tuple[int, int], bool]:
    """Choose the lists' tile and whether they may be exact.

    Where extents enclose everything visible, the image does not depend on the tile and the kernels use their own; where
    the tile has a meaning (profile "inria", counts of visited entries) it is the caller's.

    Raises:
        NotImplementedError: the caller's tile is not made of the warps' 16 x 8 tiles.
    """
    if settings.profile.extent == "opacity_aware" and not counted:
        return WARP_TILE, True
    if settings.tile_size % WARP_TILE[0] != 0:
        why = "counts of visited entries" if counted else f"profile {settings.profile.name!r}"
        raise NotImplementedError(f"tile_size={settings.tile_size} with {why}: the CUDA kernels need a multiple of 16")
    return (settings.tile_size, settings.tile_size), False


def count_instances(
    lists: Any, splats: Any, profile: Any, state: int, device: torch.device, side: SideStream | None = None
) -> None:
    """Sort splats by depth, count the tiles of each, and number its instances, front to back.

    Args:
        lists: the kernels' `TileLists`.
        splats: the kernels' view of projected Gaussians.
        profile: of the kernels.
        state: address of the device's flags.
        device: where.
        side: tiles are counted in parallel with the sort, since they do not depend on the order; None takes turns.
    """
    kernels, side = load(), side or SideStream(device, used=False)
    with side.beside():
        kernels.count_tiles(lists, splats, profile, stream_of(device))
    kernels.sort_by_depth(lists, splats, stream_of(device))
    side.join()
    kernels.number_instances(lists, state, stream_of(device))


def make_lists(
    settings: Settings,
    splats: Any,
    n: int,
    device: torch.device,
    tile: tuple[int, int],
    exact: bool,
    state: Tensor | None = None,
) -> TileBuffers:
    """List splats by tile, with buffers of exactly the size that is needed: one synchronisation.

    Raises:
        ValueError: a Gaussian projects to a value that is not finite; the message names its index.
        CudaMemoryError: no room.
    """
    kernels, stream = load(), stream_of(device)
    state = new_state(device) if state is None else state
    buckets = settings.backward == "gaussian_parallel" and tile == WARP_TILE
    buffers = TileBuffers(n, settings.width, settings.height, tile, exact, device, buckets)
    profile = settings.kernel_profile()
    count_instances(buffers.struct, splats, profile, state.data_ptr(), device)
    values = state.tolist()
    if values[BAD_ROW] != NOT_BAD:
        raise ValueError(
            f"Gaussian {values[BAD_ROW]} has a value that is not finite, or projects to one; look at row "
            f"{values[BAD_ROW]} of means, quats, scales, opacities and colors for NaN, inf and numbers near 1e38"
        )
    buffers.reserve(values[N_INSTANCES])
    kernels.make_tile_lists(buffers.struct, splats, profile, 0, state.data_ptr(), stream)
    return buffers


class Capacity:
    """Keeps the room of every image size.

    Args:
        sizes: (width, height) of every view, px.
    """

    def __init__(self, sizes: Sequence[Size]) -> None:
        self._sizes = list(sizes)
        self._seen = [0] * len(self._sizes)
        self._rooms: dict[Size, int] = {}
        self._n = 0

    def note(self, view: int, instances: int) -> None:
        """Keep how many instances a view had."""
        self._seen[view] = instances

    def overflowed(self, view: int, instances: int) -> Size:
        """Make room for a view that did not fit, and return its size."""
        self.note(view, instances)
        size = self._sizes[view]
        self._rooms[size] = _room_for(instances)
        return size

    def settle(self, n: int) -> None:
        """Bring rooms back to what is needed; the number of Gaussians is `n` from now on."""
        # clones and children of splits add to the need, in proportion at most; pruned Gaussians were hardly there
        more = max(n / self._n, 1.0) if self._n else 1.0
        self._seen = [min(round(more * seen), MOST) for seen in self._seen]
        self._n = n
        for size, room in self._rooms.items():
            need = self._need(size)
            if need and not KEPT[0] * need <= room <= KEPT[1] * need:
                self._rooms[size] = _room_for(need)

    def room(self, size: Size) -> int:
        """Return how many instances an image of that size gets room for, at least 1."""
        if size not in self._rooms:
            need = self._need(size)
            per_gaussian, least = FIRST_GUESS
            self._rooms[size] = _room_for(need) if need else max(per_gaussian * self._n, least, 1)
        return self._rooms[size]

    def _need(self, size: Size) -> int:
        """Return the most that a view of that size had, or, where none was drawn, what its pixels let expect."""
        own = max((seen for seen, other in zip(self._seen, self._sizes, strict=True) if other == size), default=0)
        if own:
            return own
        shares = [seen / (width * height) for seen, (width, height) in zip(self._seen, self._sizes, strict=True)]
        return round(max(shares, default=0.0) * size[0] * size[1])


def _room_for(need: int) -> int:
    return need if need > MOST else min(int(GROWTH * need) + 1, MOST)
