"""Sums over pixels by the compiled library (`scores.h`): what its functions are given, and their totals.

Tiles are shared out to threads. Each entry of the tile lists gets a row of its own, and the rows of a splat are added
up in the order of the lists, so that no bit depends on the number of threads.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.compiled.compositing import aligned_records, blend_numbers
from pop_fast.compiled.library import Scores, call_library, this_library
from pop_fast.stages.compositing import BlendOptions
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_ref.constants import Profile


def scored(
    layout: type[Scores],
    splats: Splats,
    colors: Tensor,
    lists: TileLists,
    size: tuple[int, int],
    profile: Profile,
    numbers: dict[str, float],
    **tensors: Tensor | None,
) -> None:
    """Call a function of `scores.h`.

    Args:
        layout: of its arguments, which tells the functions apart.
        splats: what is blended.
        colors: of any number of channels. [N, D]
        lists: what each tile blends.
        size: width and height, px.
        profile: constants and strictness.
        numbers: what else it takes of numbers.
        tensors: what else it reads and, contiguous, writes.
    """
    inputs = tuple(t.contiguous() for t in (splats.means2d, splats.conics, splats.opacities, colors))
    options = BlendOptions(lists, *size, profile, dominance=False, counts=False, keep=False, absgrad_sink=None)
    names = ("means2d", "conics", "opacities", "colors")
    given: dict[str, Tensor | None] = {
        **dict(zip(names, inputs, strict=True)),
        "ids": lists.ids,
        "offsets": lists.offsets,
        "n_reached": torch.empty_like(lists.lengths),
        "splats": aligned_records(len(inputs[0]), this_library().splat_bytes),
        **tensors,
    }
    call_library(layout, inputs[0].dtype, {**blend_numbers(inputs, options), **numbers}, given)


def totals(
    layout: type[Scores],
    columns: int,
    splats: Splats,
    colors: Tensor,
    lists: TileLists,
    size: tuple[int, int],
    profile: Profile,
    **tensors: Tensor | None,
) -> Tensor:
    """Return what a function of `scores.h` sums up of every splat; see `scored`. [N, columns] float64"""
    found = torch.empty((len(splats.means2d), columns), dtype=torch.float64)
    rows = splats.means2d.new_empty((len(lists.ids), columns))
    scored(layout, splats, colors, lists, size, profile, {}, rows=rows, totals=found, **tensors)
    return found
