"""The (splat, pixel) pairs of a blend, a step of `Blender` at a time, for sums over the pixels of every splat.

A pass over a view asks of every splat for a sum over the pixels where it is blended. A tile-list entry holds one
splat's pixels of one tile: the pass writes one row an entry, and the rows of a splat are added up in the order of the
lists, in float64.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.blend import buffers
from pop_fast.stages.blend.blend import Blender
from pop_fast.stages.blend.tile_groups import BLOCK, Entries, PackedLists, TileGroup, tile_groups
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import Profile


@dataclass(frozen=True)
class Pairs:
    """One step: n tiles, K list entries of each, all P pixels of a tile. What it holds is gone with the next step.

    Attributes:
        tiles: [n]
        rows: place of every entry in the packed lists. [n, K]
        ids: splat of every entry, the number of splats for padding. [n, K]
        coefficients: of the entries' exponents. [n K, 6]
        colors: of the entries. [n, K, D]
        alpha: 0 where an entry is not blended, and off the image. [n, K, P]
        weight: T alpha. [n, K, P]
        scratch: for whatever is computed from these. [n, K, P]
    """

    tiles: Tensor
    rows: Tensor
    ids: Tensor
    coefficients: Tensor
    colors: Tensor
    alpha: Tensor
    weight: Tensor
    scratch: Tensor


class PairWalk:
    """Goes through the pairs of a view.

    Args:
        splats: with their colours.
        lists: what each tile blends.
        width: px.
        height: px.
        profile: constants and strictness.
    """

    def __init__(self, splats: Splats, lists: TileLists, width: int, height: int, profile: Profile) -> None:
        colors = splats.means2d.new_empty((len(splats.means2d), 0)) if splats.colors is None else splats.colors
        self.lists, self.size, self.n_splats = lists, (height, width), len(splats.means2d)
        self.entries = Entries.of(splats.means2d, PackedLists.of(lists, self.n_splats))
        self.blender = Blender.of(self.entries, splats.conics, splats.opacities, colors, profile)
        self.groups = tile_groups(self.entries.lists)
        self._inside = self.tiles_of(colors.new_ones((*self.size, 1)))[:, 0]

    def front_to_back(self) -> Iterator[Pairs]:
        """Yield the steps such that, in every tile, nearer entries come first."""
        return self._walk(backwards=False)

    def back_to_front(self) -> Iterator[Pairs]:
        """Yield the steps such that, in every tile, farther entries come first; within a step the nearer do."""
        return self._walk(backwards=True)

    def color_dot_grads(self, background: Tensor) -> Iterator[tuple[Pairs, Tensor]]:
        """Yield the steps back to front, with how far every splat's colour exceeds the light from behind it.

        With B_m = background behind a pixel's last splat and B_{i-1} = alpha_i c_i + (1 - alpha_i) B_i, that is
        c_i - B_i = dC/dalpha_i / T_i.

        Args:
            background: colour behind everything. [D]

        Yields:
            Pairs, and the differences. [D, n, K, P]
        """
        n_tiles, n_pixels = self._inside.shape
        behind = background.to(self._inside.dtype)[:, None, None].expand(-1, n_tiles, n_pixels).clone()
        for pairs in self.back_to_front():
            passing = behind.index_select(1, pairs.tiles)
            colors = pairs.colors.permute(2, 1, 0)[..., None]
            color_dot_grad = behind.new_empty((len(behind), *pairs.alpha.shape))
            for k in range(pairs.alpha.shape[1] - 1, -1, -1):
                torch.sub(colors[:, k], passing, out=color_dot_grad[:, :, k])
                passing.addcmul_(pairs.alpha[:, k], color_dot_grad[:, :, k])
            behind.index_copy_(1, pairs.tiles, passing)
            yield pairs, color_dot_grad

    def _walk(self, backwards: bool) -> Iterator[Pairs]:
        for group in self.groups:
            blend = self.blender.blend(group)
            with buffers.acquired(3, group.slab, self.blender.table.dtype) as scratch:
                for step in reversed(blend.steps) if backwards else blend.steps:
                    yield self._pairs(group, step.rows, step.blocks, self.blender.again(group, step, scratch))
                    buffers.release(step.transmittance)

    def _pairs(self, group: TileGroup, chosen: Tensor | None, blocks: Tensor, made: list[Tensor]) -> Pairs:
        entries, alpha, weight, scratch = made
        tiles = (group.tiles if chosen is None else group.tiles[chosen])[: len(blocks)]
        inside = self._inside.index_select(0, tiles)[:, None]
        rows = (BLOCK * blocks[:, :, None] + torch.arange(BLOCK)).view(len(blocks), -1)
        coefficients = entries.view(-1, entries.shape[2])[:, :6]
        ids = self.entries.lists.ids[rows]
        return Pairs(
            tiles, rows, ids, coefficients, entries[:, :, 6:-1], alpha.mul_(inside), weight.mul_(inside), scratch
        )

    def offsets(self, pairs: Pairs) -> tuple[Tensor, Tensor]:
        """Return how far every splat's centre lies from every pixel's, along x and y, px. [n, K, P] each"""
        basis = self.blender.basis
        u, v = (t[pairs.rows].to(basis.dtype)[:, :, None] for t in (self.entries.u, self.entries.v))
        return u - basis[1], v - basis[2]

    def tiles_of(self, image: Tensor) -> Tensor:
        """Cut an image [H, W, C] into tiles, zero off the image. [tiles, C, P]"""
        (height, width), lists, channels = self.size, self.lists, image.shape[2]
        size = lists.tile_size
        whole = image.new_zeros((lists.tiles_y * size, lists.tiles_x * size, channels))
        whole[:height, :width] = image
        grid = whole.view(lists.tiles_y, size, lists.tiles_x, size, channels).permute(0, 2, 4, 1, 3)
        return grid.reshape(lists.tiles_y * lists.tiles_x, channels, size * size)

    def image_of(self, tiles: Tensor) -> Tensor:
        """Put an image [H, W] together from its tiles [tiles, P]."""
        (height, width), lists = self.size, self.lists
        grid = tiles.view(lists.tiles_y, lists.tiles_x, lists.tile_size, lists.tile_size).transpose(1, 2)
        return grid.reshape(lists.tiles_y * lists.tile_size, -1)[:height, :width]


class EntryRows:
    """One row of sums an entry, added up for every splat.

    Args:
        walk: whose entries they are.
        columns: numbers in a row.
    """

    def __init__(self, walk: PairWalk, columns: int) -> None:
        self._ids, self._n = walk.entries.lists.ids, walk.n_splats
        self._columns = walk.blender.table.new_zeros((columns, len(self._ids)))

    def put(self, pairs: Pairs, sums: list[Tensor]) -> None:
        """Write down what a step's entries sum up, [n, K] each."""
        rows = pairs.rows.reshape(-1)
        for column, values in zip(self._columns, sums, strict=True):
            column.index_copy_(0, rows, values.reshape(-1))

    def totals(self) -> Tensor:
        """Add up the rows of every splat. [N, columns] float64"""
        totals = torch.zeros((len(self._columns), self._n + 1), dtype=torch.float64)
        for total, column in zip(totals, self._columns, strict=True):
            total.scatter_add_(0, self._ids, column.double())
        return totals[:, :-1].T


def background_or_black(background: Tensor | None, colors: Tensor) -> Tensor:
    """Return the colour behind everything, black where none is given, in the precision of the colours. [D]

    Raises:
        ValueError: it has other channels than the colours.
    """
    behind = colors.new_zeros(colors.shape[1]) if background is None else background.to(colors.dtype)
    if behind.shape != colors.shape[1:]:
        raise ValueError(f"background has shape {list(behind.shape)}; it must be {list(colors.shape[1:])}, as a colour")
    return behind


def check_grid(lists: TileLists, width: int, height: int, tile_size: int) -> None:
    """Make sure that lists are those of a grid.

    Raises:
        ValueError: they are not.
    """
    tiles = (-(-width // tile_size), -(-height // tile_size))
    if (lists.tile_size, lists.tiles_x, lists.tiles_y) != (tile_size, *tiles):
        raise ValueError(
            f"the lists are of {lists.tiles_x} x {lists.tiles_y} tiles of {lists.tile_size} px; "
            f"{width} x {height} px in tiles of {tile_size} px are {tiles[0]} x {tiles[1]}"
        )
