"""Views drawn by the compiled library, differentiably: covariances, projection, colours, lists, blend, and passes.

Meaning: `pop_ref.splatting`, `pop_ref.compositing`. The arithmetic of one Gaussian is the one that the CUDA kernels run
(`cuda_ext/csrc/splatting.cuh`, `harmonics.cuh`). The blend (`forward.h`, `backward.h`) takes sixteen pixels at a time
in float32, tiles shared out to threads; entries that lie under the alpha floor for all sixteen are passed over; what is
kept for the transpose is the light of every pixel before every sixteenth entry. Sums over pixels (`scores.h`) have a
row an entry of the tile lists, and the rows of a splat are added up in the order of the lists, so that no bit depends
on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from pop_fast.compiled.library import PROJECTION_CONSTANTS, call_library, this_library
from pop_fast.stages import compositing
from pop_fast.stages import contributions as passes
from pop_fast.stages.blend import Stop, below
from pop_fast.stages.compositing import BlendOptions
from pop_fast.stages.harmonics import check_bands
from pop_fast.stages.projection import intrinsics, view_dirs_vjp
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of
from pop_fast.stages.tiles import TileLists, grid_size, listed_rows, tile_rects
from pop_fast.stages.types import Camera, full_precision_backward
from pop_ref.constants import PAPER, Profile

P = ParamSpec("P")
T = TypeVar("T")


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
    order = listed_rows(rects.T, depths)
    candidates = torch.zeros(len(order) + 1, dtype=torch.int64)
    torch.cumsum(((x1 - x0) * (y1 - y0)).index_select(0, order), 0, out=candidates[1:])
    n_candidates = int(candidates[-1])
    ids, tiles = torch.empty(n_candidates, dtype=torch.int64), torch.empty(n_candidates, dtype=torch.int32)
    offsets = torch.empty(tiles_x * tiles_y + 1, dtype=torch.int64)
    exact = {} if conics is None or opacities is None else {"conics": conics, "opacities": opacities}
    call_library(
        "lists",
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
        call_library("forward", means2d.dtype, blend_numbers(inputs, options), given)
        # saved, not held: autograd lets go of them with the graph
        ctx.options, ctx.kept = options, tuple(kept)
        ctx.save_for_backward(*inputs, *kept.values())
        ctx.mark_non_differentiable(*(tensor for tensor in list(results.values())[2:] if tensor is not None))
        ctx.set_materialize_grads(False)
        return (*results.values(), n_pairs.sum())

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_image: Tensor | None, v_alphas: Tensor | None, *_: None) -> tuple[Tensor | None, ...]:
        options: BlendOptions = ctx.options
        # asked for once, as checkpoints want it
        saved, sink = ctx.saved_tensors, options.absgrad_sink
        inputs, kept = saved[:4], saved[4:]
        # component rows, as the projection's transpose takes them
        found = {name: tensor.new_empty(tensor.shape[::-1]) for name, tensor in zip(_RESULTS, inputs, strict=True)}
        absolute = None if sink is None else sink.new_empty(sink.shape[::-1])
        columns = 6 + inputs[3].shape[1] + 2 * (sink is not None)
        rows = inputs[0].new_empty((len(options.lists.ids), columns))
        given = {"v_image": v_image, "v_alphas": v_alphas, "rows": rows, "absgrad": absolute}
        given = {**_arguments(inputs, options), **given, **found, **dict(zip(ctx.kept, kept, strict=True))}
        call_library("backward", inputs[0].dtype, blend_numbers(inputs, options), given)
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
    lists, profile, dtype, channels = options.lists, options.profile, inputs[0].dtype, inputs[3].shape[1]
    grid = {name: getattr(lists, name) for name in ("tiles_x", "tiles_y", "tile_size")}
    sizes = {"n": len(inputs[0]), "channels": channels, "width": options.width, "height": options.height}
    layout = {"pixel_stride": channels, "channel_stride": 1, "threads": torch.get_num_threads()}
    stops = {"alpha_floor": below(profile.alpha_floor, dtype), "stop": Stop.of(profile, dtype).at}
    ceiling = {"alpha_ceiling": profile.alpha_ceiling, "ceiling_passes": profile.as_numbers()["pass_ceiling"]}
    return {**grid, **sizes, **layout, **stops, **ceiling}


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
        # two bit sets of sixteen entries for every strip, one for each of its halves
        "reached": torch.empty(n_pixels // library.lanes(like.dtype.itemsize), dtype=torch.int32),
    }


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """See `pop_fast.stages.splatting.covariances`."""
    return _Covariances.apply(quats, scales)


def project(means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings) -> Splats:
    """See `pop_fast.stages.splatting.project`; rows of culled Gaussians hold 0, but for depths and opacities.

    Optimizations: one pass over the Gaussians forward and one backward, which compute everything in between anew.
    """
    return Splats(*_Projection.apply(means, covars, opacities, viewmat, view))


def colors_of_view(sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
    """See `pop_fast.stages.splatting.colors_of_view`; ValueError where `visible` is no list of rows, ascending,
    or `degree` needs more coefficients than there are.

    Optimizations: one pass over the coefficients forward and one backward (`colors.h`).
    """
    if visible.dtype != torch.int64 or visible.dim() != 1:
        shape = list(visible.shape)
        raise ValueError(
            f"visible is a tensor of {visible.dtype} and shape {shape}; it must hold the numbers of the rows to "
            "evaluate, torch.int64 [V]; of a mask these are mask.nonzero().squeeze(1)"
        )
    if not bool((visible[1:] > visible[:-1]).all()):
        raise ValueError("visible must name rows in ascending order, each once; use visible.unique()")
    if len(visible) and not (int(visible[0]) >= 0 and int(visible[-1]) < len(sh)):
        raise ValueError(f"visible names row {int(visible[0])} to {int(visible[-1])}; there are {len(sh)}")
    check_bands(sh.shape[1], degree)
    return _Colors.apply(sh, means, viewmat, degree, visible)


class _Covariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, quats: Tensor, scales: Tensor) -> Tensor:
        covars = quats.new_empty((len(quats), 3, 3))
        given = {"quats": quats, "scales": scales, "covars": covars}
        call_library("covariances", quats.dtype, {"n": len(quats), "threads": torch.get_num_threads()}, given)
        ctx.save_for_backward(quats, scales)
        return covars

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_covars: Tensor) -> tuple[Tensor, Tensor]:
        quats, scales = ctx.saved_tensors
        v_quats, v_scales = quats.new_empty(quats.shape), scales.new_empty(scales.shape)
        given = {"quats": quats, "scales": scales, "v_covars": v_covars, "v_quats": v_quats, "v_scales": v_scales}
        call_library("covariances_backward", quats.dtype, {"n": len(quats), "threads": torch.get_num_threads()}, given)
        return v_quats, v_scales


class _Projection(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, covars: Tensor, opacities: Tensor, viewmat: Tensor, view: ProjectionSettings
    ) -> tuple[Tensor | None, ...]:
        n = len(means)
        results = {
            "means2d": means.new_empty((n, 2)),
            "depths": means.new_empty(n),
            "conics": means.new_empty((n, 3)),
            "effective_opacities": means.new_empty(n),
            "radii": torch.empty((n, 2), dtype=torch.int32),
            "factors": means.new_empty(n) if view.antialiased else None,
        }
        given = {"means": means, "covars": covars, "opacities": opacities, "viewmat": viewmat, "K": view.K}
        call_library("projection", means.dtype, _projection_numbers(n, view), {**given, **results})
        ctx.view = view
        ctx.save_for_backward(means, covars, opacities, viewmat, results["radii"])
        ctx.mark_non_differentiable(results["radii"])
        return tuple(results.values())

    @staticmethod
    @full_precision_backward
    def backward(
        ctx: Any,
        v_means2d: Tensor,
        v_depths: Tensor,
        v_conics: Tensor,
        v_effective_opacities: Tensor,
        _v_radii: None,
        v_factors: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        means, covars, opacities, viewmat, radii = ctx.saved_tensors
        n_parts = -(-len(means) // this_library().rows_at_a_time)
        found = [torch.empty_like(t, memory_format=torch.contiguous_format) for t in (means, covars, opacities)]
        v_viewmats = means.new_empty((n_parts, 3, 4)) if ctx.needs_input_grad[3] else None
        given = {"means": means, "covars": covars, "opacities": opacities, "viewmat": viewmat, "K": ctx.view.K}
        given |= {"v_means2d": v_means2d.T, "v_depths": v_depths, "v_conics": v_conics.T}
        given |= {"v_effective_opacities": v_effective_opacities, "v_factors": v_factors}
        given |= {"radii": radii, "v_viewmats": v_viewmats}
        given |= dict(zip(("v_means", "v_covars", "v_opacities"), found, strict=True))
        call_library("projection_backward", means.dtype, _projection_numbers(len(means), ctx.view), given)
        if v_viewmats is None:
            return (*found, None, None)
        v_viewmat = torch.zeros_like(viewmat)
        v_viewmat[:3] = v_viewmats.sum(0, dtype=torch.float64)
        return (*found, v_viewmat, None)


def _projection_numbers(n: int, view: ProjectionSettings) -> dict[str, float]:
    constants = view.profile.as_numbers()
    return {
        **{name: constants[name] for name in (*PROJECTION_CONSTANTS, "tile_size")},
        **{name: getattr(view, name) for name in ("antialiased", "radius_clip", "width", "height")},
        "n": n,
        "threads": torch.get_num_threads(),
    }


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, viewmat: Tensor, degree: int, visible: Tensor) -> Tensor:
        colors = sh.new_empty((3, len(sh)))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible, "colors": colors}
        call_library("colors", sh.dtype, _numbers(sh, degree, visible), given)
        ctx.degree = degree
        ctx.save_for_backward(sh, means, viewmat, visible)
        return colors.T

    @staticmethod
    @full_precision_backward
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        sh, means, viewmat, visible = ctx.saved_tensors
        v_sh, v_dirs = torch.empty_like(sh, memory_format=torch.contiguous_format), sh.new_empty((len(sh), 3))
        given = {"sh": sh, "means": means, "viewmat": viewmat, "visible": visible}
        given |= {"v_colors": v_colors, "v_sh": v_sh, "v_dirs": v_dirs}
        call_library("colors_backward", sh.dtype, _numbers(sh, ctx.degree, visible), given)
        if not ctx.needs_input_grad[2]:
            return v_sh, v_dirs, None, None, None
        _, v_viewmat = view_dirs_vjp(means.index_select(0, visible), viewmat, v_dirs.index_select(0, visible))
        return v_sh, v_dirs, v_viewmat, None, None


def _numbers(sh: Tensor, degree: int, visible: Tensor) -> dict[str, float]:
    sizes = {"n": len(sh), "n_visible": len(visible), "n_sh": sh.shape[1]}
    return {**sizes, "degree": degree, "threads": torch.get_num_threads()}


def _scored(
    name: str,
    splats: Splats,
    colors: Tensor,
    lists: TileLists,
    size: tuple[int, int],
    profile: Profile,
    numbers: dict[str, float],
    **tensors: Tensor | None,
) -> None:
    """Call a function of `scores.h`; `tensors` it reads and, contiguous, writes."""
    inputs = tuple(t.contiguous() for t in (splats.means2d, splats.conics, splats.opacities, colors))
    options = BlendOptions(lists, *size, profile, dominance=False, counts=False, keep=False, absgrad_sink=None)
    given = {
        **_arguments(inputs, options),
        "n_reached": torch.empty_like(lists.lengths),
        "splats": aligned_records(len(inputs[0]), this_library().splat_bytes),
        **tensors,
    }
    call_library(name, inputs[0].dtype, {**blend_numbers(inputs, options), **numbers}, given)


def _sums(name: str, columns: int, given: str) -> Callable[..., Tensor]:
    """Make what sums up of every splat by a function of `scores.h`, which takes a map or a background by that name."""

    def sums(splats: Splats, lists: TileLists, size: tuple[int, int], profile: Profile, value: Tensor | None) -> Tensor:
        found = torch.empty((len(splats.means2d), columns), dtype=torch.float64)
        rows = splats.means2d.new_empty((len(lists.ids), columns))
        # a map takes no colours
        colors = rows.new_empty((len(found), 0)) if given == "pixel_map" else colors_of(splats)
        tensors: dict[str, Tensor | None] = {given: value, "rows": rows, "totals": found}
        _scored(name, splats, colors, lists, size, profile, {}, **tensors)
        return found

    return sums


def _dominant_ids(
    splats: Splats, lists: TileLists, camera: Camera, profile: Profile, facing: Tensor
) -> tuple[Tensor, Tensor]:
    size, like = (camera.width, camera.height), splats.means2d
    ids, T_final = torch.empty(size[::-1], dtype=torch.int64), like.new_empty(size[::-1])
    rays: dict[str, float] = dict(zip(("fx", "fy", "cx", "cy"), intrinsics(camera.K, *size, profile), strict=True))
    results = {"dominant_ids": ids, "T_final": T_final}
    _scored(
        "dominant_points", splats, like.new_empty((len(like), 0)), lists, size, profile, rays, facing=facing, **results
    )
    return ids, T_final


def _by_the_library(stage: Callable[P, T], /, **own: Any) -> Callable[P, T]:
    """Make a stage of torch's that leaves its work to the library's functions."""
    bound = partial(stage, **own)

    @wraps(stage, assigned=("__name__", "__qualname__", "__doc__"))
    def compiled(*args: P.args, **kwargs: P.kwargs) -> T:
        return bound(*args, **kwargs)

    return compiled


composite = _by_the_library(compositing.composite, function=_Composite)
contributions = _by_the_library(passes.contributions, sums=_sums("contributions", 4, "pixel_map"))
sensitivities = _by_the_library(passes.sensitivities, sums=_sums("sensitivities", 1, "background"))
screen_moments = _by_the_library(passes.screen_moments, sums=_sums("screen_moments", passes.N_MOMENTS, "background"))
dominant_points = _by_the_library(passes.dominant_points, find=_dominant_ids)
fisher_blocks = _by_the_library(
    passes.fisher_blocks, project=project, colors_of_view=colors_of_view, covariances=covariances
)
