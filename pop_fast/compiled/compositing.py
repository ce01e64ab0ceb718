"""Blend splats into an image by the compiled library, differentiably. Meaning: `pop_ref.compositing`.

Optimizations: in C++ (`forward.h`, `backward.h`), sixteen pixels at a time in float32, tiles shared out to threads;
entries that lie under the alpha floor for all sixteen are passed over; what is kept for the transpose is the light of
every pixel before every sixteenth entry.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.compiled.library import Blend, BlendBackward, Lists, call_library, this_library
from pop_fast.stages.blend.blend import Stop, below
from pop_fast.stages.compositing import BlendOptions
from pop_fast.stages.compositing import composite as composite_in_torch
from pop_fast.stages.tiles import TileLists, depth_order, grid_size, tile_rects
from pop_ref.constants import PAPER, Profile


def tile_lists(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    width: int,
    height: int,
    tile_size: int,
    profile: Profile = PAPER,
    *,
    conics: Tensor | None = None,
    opacities: Tensor | None = None,
) -> TileLists:
    """See `pop_ref.tiles.tile_lists` (D3, D4), and `pop_fast.stages.tiles.tile_lists` for `conics` and `opacities`.

    Optimizations: rectangles and depth order are torch's; a counting sort by tile of entries that are made in depth
    order (`lists.h`).
    """
    tiles_x, tiles_y = grid_size(width, height, tile_size)
    rects = tile_rects(means2d, radii, width, height, tile_size, profile).T.contiguous()
    x0, y0, x1, y1 = rects
    rows = ((x1 > x0) & (y1 > y0)).nonzero().squeeze(1)
    order = rows.index_select(0, depth_order(depths.index_select(0, rows)))
    candidates = torch.zeros(len(order) + 1, dtype=torch.int64)
    torch.cumsum(((x1 - x0) * (y1 - y0)).index_select(0, order), 0, out=candidates[1:])
    n_candidates = int(candidates[-1])
    ids, tiles = torch.empty(n_candidates, dtype=torch.int64), torch.empty(n_candidates, dtype=torch.int32)
    offsets = torch.empty(tiles_x * tiles_y + 1, dtype=torch.int64)
    exact = {} if conics is None or opacities is None else {"conics": conics, "opacities": opacities}
    call_library(
        Lists,
        means2d.dtype,
        {"n": len(means2d), "m": len(order), "tiles_x": tiles_x, "tiles_y": tiles_y, "tile_size": tile_size}
        | {"threads": torch.get_num_threads(), "alpha_floor": profile.alpha_floor},
        {"means2d": means2d, **exact, "rects": rects, "order": order, "candidates": candidates}
        | {"tiles": tiles, "ids": ids, "offsets": offsets},
    )
    return TileLists(ids[: int(offsets[-1])], offsets, tile_size, tiles_x, tiles_y)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, options: BlendOptions
    ) -> tuple[Tensor | None, ...]:
        # once for both directions
        inputs = tuple(tensor.contiguous() for tensor in (means2d, conics, opacities, colors))
        lists = options.lists
        size = (options.height, options.width)
        results = {
            "image": colors.new_empty((*size, colors.shape[1])),
            "alphas": colors.new_empty(size),
            "dominant_ids": torch.empty(size, dtype=torch.int64) if options.dominance else None,
            "dominant_weights": colors.new_empty(size) if options.dominance else None,
            "n_blended": torch.empty(size, dtype=torch.int32) if options.counts else None,
            "n_traversed": torch.empty(size, dtype=torch.int32) if options.counts else None,
        }
        n_pairs, n_reached = (torch.empty_like(lists.lengths) for _ in range(2))
        splats = aligned_records(len(means2d), this_library().splat_bytes)
        kept = {"n_reached": n_reached, "splats": splats, **(_lights(lists, colors) if options.keep else {})}
        given = {**_arguments(inputs, options), **results, **kept, "n_pairs": n_pairs}
        call_library(Blend, means2d.dtype, blend_numbers(inputs, options), given)
        # saved, not held: autograd lets go of them with the graph
        ctx.options, ctx.kept = options, tuple(kept)
        ctx.save_for_backward(*inputs, *kept.values())
        ctx.mark_non_differentiable(*(tensor for tensor in list(results.values())[2:] if tensor is not None))
        ctx.set_materialize_grads(False)
        return (*results.values(), n_pairs.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        options: BlendOptions = ctx.options
        inputs, kept, sink = ctx.saved_tensors[:4], ctx.saved_tensors[4:], options.absgrad_sink
        # component rows, as the projection's transpose takes them
        found = {name: tensor.new_empty(tensor.shape[::-1]) for name, tensor in zip(_RESULTS, inputs, strict=True)}
        absolute = None if sink is None else sink.new_empty(sink.shape[::-1])
        columns = 6 + inputs[3].shape[1] + 2 * (sink is not None)
        rows = inputs[0].new_empty((len(options.lists.ids), columns))
        given = {"v_image": v_image, "v_alphas": v_alphas, "rows": rows, "absgrad": absolute}
        given = {**_arguments(inputs, options), **given, **found, **dict(zip(ctx.kept, kept, strict=True))}
        call_library(BlendBackward, inputs[0].dtype, blend_numbers(inputs, options), given)
        if sink is not None and absolute is not None:
            sink.add_(absolute.T)
        v_means2d, v_conics, v_opacities, v_colors = found.values()
        return v_means2d.T, v_conics.T, v_opacities, v_colors.T, None


_RESULTS = ("v_means2d", "v_conics", "v_opacities", "v_colors")


def _arguments(inputs: tuple[Tensor, ...], options: BlendOptions) -> dict[str, Tensor | None]:
    means2d, conics, opacities, colors = inputs
    splats = {"means2d": means2d, "conics": conics, "opacities": opacities, "colors": colors}
    return {**splats, "ids": options.lists.ids, "offsets": options.lists.offsets}


def blend_numbers(inputs: tuple[Tensor, ...], options: BlendOptions) -> dict[str, float]:
    """Return the fields of a blend that are numbers."""
    lists, profile, dtype = options.lists, options.profile, inputs[0].dtype
    return {
        "n": len(inputs[0]),
        "channels": inputs[3].shape[1],
        "tiles_x": lists.tiles_x,
        "tiles_y": lists.tiles_y,
        "tile_size": lists.tile_size,
        "width": options.width,
        "height": options.height,
        "threads": torch.get_num_threads(),
        "alpha_floor": below(profile.alpha_floor, dtype),
        "alpha_ceiling": profile.alpha_ceiling,
        "stop": Stop.of(profile, dtype).at,
        "pixel_stride": inputs[3].shape[1],
        "channel_stride": 1,
        "ceiling_passes": profile.as_numbers()["pass_ceiling"],
    }


def aligned_records(n: int, each: int) -> Tensor:
    """Return bytes for n records that begin where lines of the cache do."""
    room = torch.empty((n + 1) * each, dtype=torch.uint8)
    skip = -room.data_ptr() % each
    return room[skip : skip + n * each]


def _lights(lists: TileLists, like: Tensor) -> dict[str, Tensor]:
    """Return space for T before every chunk, for which entries reach which strips, and where each tile's begins."""
    library = this_library()
    chunks = (lists.lengths + (library.chunk - 1)) // library.chunk
    pixels = library.padded_pixels(lists.tile_size, like.dtype.itemsize)
    n_pixels = int(chunks.sum()) * pixels
    return {
        "first_chunks": chunks.cumsum(0) - chunks,
        "transmittances": like.new_empty(n_pixels),
        "reached": torch.empty(n_pixels // library.lanes(like.dtype.itemsize), dtype=torch.int16),
    }


composite = partial(composite_in_torch, function=_Composite)
