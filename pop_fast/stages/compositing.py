"""Blend splats into an image, differentiably, by `pop_fast.stages.blend`, and count what each dominates (D8).

Meaning: `pop_ref.compositing`, `pop_ref.dominance`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.blend import Blender, GroupBlend
from pop_fast.stages.tile_groups import (
    BLOCK,
    Entries,
    PackedLists,
    TileGroup,
    centred_moments,
    splat_gradients,
    tile_groups,
)
from pop_fast.stages.tiles import TileLists, check_grid
from pop_fast.stages.types import full_precision_backward
from pop_ref.constants import PAPER, Profile


@dataclass(frozen=True)
class Composite:
    """A blended view, over black."""

    image: Tensor  # weighted colours. [H, W, D]
    alphas: Tensor  # sum of weights, 1 - T_final. [H, W]
    dominant_ids: Tensor | None  # -1 where none was blended. [H, W] int64, or None when not asked for
    dominant_weights: Tensor | None  # [H, W], or None when not asked for
    n_blended: Tensor | None  # [H, W] int32, or None when not asked for
    # list entries visited, the terminating one included. [H, W] int32, or None when not asked for
    n_traversed: Tensor | None
    n_pairs: int | None  # (entry, pixel) pairs evaluated, None if they are not counted


def composite(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    lists: TileLists,
    width: int,
    height: int,
    profile: Profile = PAPER,
    *,
    dominance: bool = False,
    counts: bool = False,
    absgrad_sink: Tensor | None = None,
    function: type[torch.autograd.Function] | None = None,
) -> Composite:
    """Blend every tile's list front to back, over black. See `pop_ref.compositing.composite`.

    Optimizations: see `pop_fast.stages.blend`; what is kept for the transpose is the light of every pixel
    before every eighth entry.

    Args:
        dominance: also find dominant ids.
        counts: also count blended and traversed entries.
        absgrad_sink: [N, 2], to which the transpose adds the sum over pixels of |dL/dmeans2d|.
        function: what blends, from the four tensors and `BlendOptions`; None takes torch's.

    Raises:
        ValueError: the lists are not of that size of image.
    """
    check_grid(lists, width, height, lists.tile_size)
    inputs = (means2d, conics, opacities, colors)
    keep = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    options = BlendOptions(lists, width, height, profile, dominance, counts, keep, absgrad_sink)
    image, alphas, ids, weights, blended, traversed, pairs = (function or _Composite).apply(*inputs, options)
    return Composite(image, alphas, ids, weights, blended, traversed, int(pairs))


@dataclass(frozen=True)
class BlendOptions:
    """What `composite` is given in addition to the tensors, and whether a transpose may follow (`keep`)."""

    lists: TileLists
    width: int
    height: int
    profile: Profile
    dominance: bool
    counts: bool
    keep: bool
    absgrad_sink: Tensor | None


@dataclass
class _Saved:
    n_splats: int
    entries: Entries
    blender: Blender
    groups: list[TileGroup]
    blends: list[GroupBlend | None]


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, options: BlendOptions
    ) -> tuple[Tensor | None, ...]:
        entries = Entries.of(means2d, PackedLists.of(options.lists, len(means2d)))
        blender = Blender.of(entries, conics, opacities, colors, options.profile)
        groups = tile_groups(entries.lists)
        canvas = _Canvas(options, entries.lists, colors.shape[1] + 1, colors.dtype)
        blends: list[GroupBlend | None] = []
        pairs = 0
        for group in groups:
            blend = blender.blend(group, options.counts, options.dominance, options.keep)
            canvas.put(group, blend)
            pairs += blend.n_pairs
            blends.append(blend)
        ctx.saved, ctx.options = _Saved(len(means2d), entries, blender, groups, blends), options
        ctx.save_for_backward(conics, opacities)
        outputs = canvas.images()
        ctx.mark_non_differentiable(*(o for o in outputs[2:] if o is not None))
        ctx.set_materialize_grads(False)
        return (*outputs, torch.tensor(pairs))

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        saved: _Saved = ctx.saved
        options: BlendOptions = ctx.options
        gradients = _Gradients(saved, options)
        tiles = _tiles_of_cotangents(v_image, v_alphas, options, saved.blender)
        for i, group in enumerate(saved.groups):
            # what an earlier backward of the same graph used up is blended again
            blend, saved.blends[i] = saved.blends[i] or saved.blender.blend(group), None
            gradients.add(group, blend, tiles.index_select(0, group.tiles))
        return (*gradients.of_splats(*ctx.saved_tensors), None)


class _Canvas:
    """The image in tiles, filled group by group."""

    def __init__(self, options: BlendOptions, packed: PackedLists, channels: int, dtype: torch.dtype) -> None:
        self.options, self.packed = options, packed
        lists = options.lists
        n_tiles, n_pixels = lists.tiles_x * lists.tiles_y, lists.tile_size**2
        self.image = torch.zeros((n_tiles, channels, n_pixels), dtype=dtype)
        self.ids = torch.full((n_tiles, n_pixels), -1) if options.dominance else None
        self.weights = torch.zeros((n_tiles, n_pixels), dtype=dtype) if options.dominance else None
        self.blended = torch.zeros((n_tiles, n_pixels), dtype=torch.int32) if options.counts else None
        self.traversed = torch.zeros((n_tiles, n_pixels), dtype=torch.int32) if options.counts else None

    def put(self, group: TileGroup, blend: GroupBlend) -> None:
        self.image.index_copy_(0, group.tiles, blend.image)
        if self.ids is not None and self.weights is not None:
            places, weights = blend.dominant_places, blend.dominant_weights
            assert places is not None
            assert weights is not None
            ids = self.packed.ids[places.clamp_min(0) + BLOCK * group.first_blocks[:, None]]
            self.ids.index_copy_(0, group.tiles, ids.masked_fill_(places < 0, -1))
            self.weights.index_copy_(0, group.tiles, weights)
        if self.blended is not None and self.traversed is not None:
            assert blend.n_blended is not None
            assert blend.n_passed is not None
            self.blended.index_copy_(0, group.tiles, blend.n_blended.to(torch.int32))
            # a pixel that stopped has also looked at the entry that stopped it; padding is passed but does not count
            lengths = self.options.lists.lengths[group.tiles]
            traversed = torch.minimum(blend.n_passed + 1, lengths[:, None])
            self.traversed.index_copy_(0, group.tiles, traversed.to(torch.int32))

    def images(self) -> tuple[Tensor | None, ...]:
        image = self._flat(self.image)
        whole = (self.ids, self.weights, self.blended, self.traversed)
        rest = tuple(None if x is None else self._flat(x[:, None])[..., 0] for x in whole)
        # copies, as views of one tensor may not be written to: a caller leaves pixels out so
        return image[..., :-1].clone(), image[..., -1].clone(), *rest

    def _flat(self, tiles: Tensor) -> Tensor:
        lists, size = self.options.lists, self.options.lists.tile_size
        grid = tiles.view(lists.tiles_y, lists.tiles_x, tiles.shape[1], size, size).permute(0, 3, 1, 4, 2)
        whole = grid.reshape(lists.tiles_y * size, lists.tiles_x * size, tiles.shape[1])
        return whole[: self.options.height, : self.options.width]


def _tiles_of_cotangents(
    v_image: Tensor | None, v_alphas: Tensor | None, options: BlendOptions, blender: Blender
) -> Tensor:
    """Cut the cotangents of image and alphas into tiles. [tiles, D + 1, P]"""
    lists, size = options.lists, options.lists.tile_size
    channels = blender.table.shape[2] - 6
    whole = blender.basis.new_zeros((lists.tiles_y * size, lists.tiles_x * size, channels))
    if v_image is not None:
        whole[: options.height, : options.width, :-1] = v_image
    if v_alphas is not None:
        whole[: options.height, : options.width, -1] = v_alphas
    grid = whole.view(lists.tiles_y, size, lists.tiles_x, size, channels).permute(0, 2, 4, 1, 3)
    return grid.reshape(lists.tiles_y * lists.tiles_x, channels, size * size)


class _Gradients:
    """Gradients of splats, gathered group by group."""

    def __init__(self, saved: _Saved, options: BlendOptions) -> None:
        self.saved, self.sink = saved, options.absgrad_sink
        table = saved.blender.table
        self.n_colors = table.shape[2] - 7
        # of every entry; zero where no step came
        self.rows = table.new_zeros((len(table), 6 + self.n_colors + 2 * (self.sink is not None), BLOCK))

    def add(self, group: TileGroup, blend: GroupBlend, v_image: Tensor) -> None:
        for blocks, rows in self.saved.blender.transpose(group, blend, v_image, self.sink is not None):
            self.rows.index_copy_(0, blocks, rows)

    def of_splats(self, conics: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sum over the entries of each splat: gradients to means2d, conics, opacities, colors."""
        columns = self.rows.transpose(0, 1).reshape(self.rows.shape[1], -1)
        moments = self._summed(centred_moments(self.saved.entries, columns[:6]))
        centres, of_conics, of_opacities = splat_gradients(moments, conics, opacities)
        rest = self._summed(columns[6:])
        if self.sink is not None:
            self.sink.add_(rest[self.n_colors :].T)
        dtype = columns.dtype
        return centres.to(dtype).T, of_conics.to(dtype).T, of_opacities.to(dtype), rest[: self.n_colors].T

    def _summed(self, columns: Tensor) -> Tensor:
        # threads share the components, and each of these is summed in order: the bits never change
        totals = columns.new_zeros((len(columns), self.saved.n_splats + 1))
        return totals.scatter_add_(1, self.saved.entries.lists.ids.expand_as(columns), columns)[:, :-1]


def dominant_counts(dominant_ids: Tensor, n: int) -> Tensor:
    """See `pop_ref.dominance.dominant_counts`. Optimizations: one bincount."""
    return torch.bincount(dominant_ids.reshape(-1) + 1, minlength=n + 1)[1:]
