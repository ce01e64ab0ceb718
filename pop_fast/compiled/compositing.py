"""Blend splats into an image by the compiled library, differentiably. Meaning: `pop_ref.compositing`."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pop_fast.compiled.build import library_path
from pop_fast.compiled.library import Blend, Library, open_library
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


class _Call:
    """One call of the library: its arguments, and the tensors that they point into."""

    def __init__(self, inputs: tuple[Tensor, ...], options: _Options) -> None:
        lists, profile, dtype = options.lists, options.profile, inputs[0].dtype
        self._tensors: list[Tensor] = []
        self._bytes = dtype.itemsize
        self._arguments = Blend(
            n=len(inputs[0]),
            channels=inputs[3].shape[1],
            tiles_x=lists.tiles_x,
            tiles_y=lists.tiles_y,
            tile_size=lists.tile_size,
            width=options.width,
            height=options.height,
            threads=torch.get_num_threads(),
            alpha_floor=below(profile.alpha_floor, dtype),
            alpha_ceiling=profile.alpha_ceiling,
            stop=Stop.of(profile, dtype).at,
            ceiling_passes=profile.ceiling_gradient != "zero",
        )
        names = ("means2d", "conics", "opacities", "colors")
        self.give(**{name: tensor.contiguous() for name, tensor in zip(names, inputs, strict=True)})
        self.give(ids=lists.ids.contiguous(), offsets=lists.offsets.contiguous())

    def give(self, **tensors: Tensor | None) -> None:
        """Let arguments point into tensors, which live as long as the call."""
        for name, tensor in tensors.items():
            if tensor is not None:
                self._tensors.append(tensor)
                setattr(self._arguments, name, tensor.data_ptr())

    def run(self, kind: str, library: Library) -> None:
        function = {"forward": library.forward, "backward": library.backward}[kind][self._bytes]
        function(ctypes.byref(self._arguments), library.fork)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, options: _Options
    ) -> tuple[Tensor | None, ...]:
        inputs, library = (means2d, conics, opacities, colors), open_library(str(library_path()))
        size = (options.height, options.width)
        image, alphas = colors.new_empty((*size, colors.shape[1])), colors.new_empty(size)
        reached = {"n_reached": _whole(options.lists.lengths), "n_pairs": _whole(options.lists.lengths)}
        asked: dict[str, Tensor | None] = {
            "dominant_ids": torch.empty(size, dtype=torch.int64) if options.dominance else None,
            "dominant_weights": colors.new_empty(size) if options.dominance else None,
            "n_blended": torch.empty(size, dtype=torch.int32) if options.counts else None,
            "n_traversed": torch.empty(size, dtype=torch.int32) if options.counts else None,
        }
        kept = _lights(options.lists, library, colors) if options.keep else {}
        call = _Call(inputs, options)
        call.give(image=image, alphas=alphas, **reached, **asked, **kept)
        call.run("forward", library)
        ctx.options, ctx.kept = options, {**kept, "n_reached": reached["n_reached"]}
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(*(tensor for tensor in asked.values() if tensor is not None))
        ctx.set_materialize_grads(False)
        return (image, alphas, *asked.values(), reached["n_pairs"].sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        options: _Options = ctx.options
        inputs = ctx.saved_tensors
        # component rows, as the projection's transpose takes them
        found = [x.new_empty(x.shape[::-1]) for x in inputs]
        sink = options.absgrad_sink
        absolute = None if sink is None else sink.new_empty(sink.shape[::-1])
        columns = 6 + inputs[3].shape[1] + 2 * (sink is not None)
        call = _Call(inputs, options)
        call.give(
            v_image=None if v_image is None else v_image.contiguous(),
            v_alphas=None if v_alphas is None else v_alphas.contiguous(),
            rows=inputs[0].new_empty((len(options.lists.ids), columns)),
            absgrad=absolute,
            **dict(zip(("v_means2d", "v_conics", "v_opacities", "v_colors"), found, strict=True)),
            **ctx.kept,
        )
        call.run("backward", open_library(str(library_path())))
        if sink is not None and absolute is not None:
            sink.add_(absolute.T)
        means2d, conics, opacities, colors = found
        return means2d.T, conics.T, opacities, colors.T, None


def _whole(like: Tensor) -> Tensor:
    return torch.empty_like(like, dtype=torch.int64)


def _lights(lists: TileLists, library: Library, like: Tensor) -> dict[str, Tensor]:
    """Return room for the light before every chunk of entries, and where each tile's begins."""
    chunks = (lists.lengths + (library.chunk - 1)) // library.chunk
    pixels = library.padded_pixels(lists.tile_size, like.dtype.itemsize)
    return {"first_chunks": chunks.cumsum(0) - chunks, "lights": like.new_empty(int(chunks.sum()) * pixels)}
