"""Blend splats into an image by the compiled library, differentiably. Meaning: `pop_ref.compositing`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.compiled.library import Blend, BlendBackward, call_library, this_library
from pop_fast.compositing import Composite
from pop_fast.tiles import TileLists
from pop_fast.transmittance import Stop, below
from pop_ref.constants import PAPER, Profile


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
) -> Composite:
    """Blend every tile's list front to back, over black. See `pop_ref.compositing.composite`.

    Optimizations: in C++ (`forward.h`, `backward.h`), sixteen pixels at a time in float32, tiles shared out to threads;
    entries that lie under the alpha floor for all sixteen are passed over; what is kept for the transpose is the light
    of every pixel before every sixteenth entry.

    Args:
        means2d: screen centres, px. [N, 2]
        conics: inverse screen covariances, px^-2. [N, 3]
        opacities: [N]
        colors: any number of channels. [N, D]
        lists: what each tile blends.
        width: px.
        height: px.
        profile: constants and strictness.
        dominance: also find dominant ids.
        counts: also count blended and traversed entries.
        absgrad_sink: [N, 2], to which the transpose adds the sum over pixels of |dL/dmeans2d|.

    Returns:
        The blended view; `image` and `alphas` are differentiable.
    """
    inputs = (means2d, conics, opacities, colors)
    keep = torch.is_grad_enabled() and any(t.requires_grad for t in inputs)
    options = _Options(lists, width, height, profile, dominance, counts, keep, absgrad_sink)
    image, alphas, ids, weights, blended, traversed, pairs = _Composite.apply(*inputs, options)
    return Composite(image, alphas, ids, weights, blended, traversed, int(pairs))


@dataclass(frozen=True)
class _Options:
    lists: TileLists
    width: int
    height: int
    profile: Profile
    dominance: bool
    counts: bool
    keep: bool
    absgrad_sink: Tensor | None


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, options: _Options
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
        splats = torch.empty((len(means2d), 6), dtype=torch.float64)
        kept = {"n_reached": n_reached, "splats": splats, **(_lights(lists, colors) if options.keep else {})}
        given = {**_arguments(inputs, options), **results, **kept, "n_pairs": n_pairs}
        call_library(Blend, means2d.dtype, _numbers(inputs, options), given)
        ctx.options, ctx.kept = options, kept
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(*(tensor for tensor in list(results.values())[2:] if tensor is not None))
        ctx.set_materialize_grads(False)
        return (*results.values(), n_pairs.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        options: _Options = ctx.options
        inputs, sink = ctx.saved_tensors, options.absgrad_sink
        # component rows, as the projection's transpose takes them
        found = {name: tensor.new_empty(tensor.shape[::-1]) for name, tensor in zip(_RESULTS, inputs, strict=True)}
        absolute = None if sink is None else sink.new_empty(sink.shape[::-1])
        columns = 6 + inputs[3].shape[1] + 2 * (sink is not None)
        rows = inputs[0].new_empty((len(options.lists.ids), columns))
        given = {"v_image": v_image, "v_alphas": v_alphas, "rows": rows, "absgrad": absolute}
        given = {**_arguments(inputs, options), **given, **found, **ctx.kept}
        call_library(BlendBackward, inputs[0].dtype, _numbers(inputs, options), given)
        if sink is not None and absolute is not None:
            sink.add_(absolute.T)
        v_means2d, v_conics, v_opacities, v_colors = found.values()
        return v_means2d.T, v_conics.T, v_opacities, v_colors.T, None


_RESULTS = ("v_means2d", "v_conics", "v_opacities", "v_colors")


def _arguments(inputs: tuple[Tensor, ...], options: _Options) -> dict[str, Tensor | None]:
    means2d, conics, opacities, colors = inputs
    splats = {"means2d": means2d, "conics": conics, "opacities": opacities, "colors": colors}
    return {**splats, "ids": options.lists.ids, "offsets": options.lists.offsets}


def _numbers(inputs: tuple[Tensor, ...], options: _Options) -> dict[str, float]:
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
        "ceiling_passes": profile.ceiling_gradient != "zero",
    }


def _lights(lists: TileLists, like: Tensor) -> dict[str, Tensor]:
    """Return room for the light before every chunk of entries, and where each tile's begins."""
    library = this_library()
    chunks = (lists.lengths + (library.chunk - 1)) // library.chunk
    pixels = library.padded_pixels(lists.tile_size, like.dtype.itemsize)
    return {
        "first_chunks": chunks.cumsum(0) - chunks,
        "lights": like.new_empty(int(chunks.sum()) * pixels),
        "strips": torch.empty_like(lists.ids),
    }
