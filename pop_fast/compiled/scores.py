"""Sums over pixels by the compiled library (`scores.h`): what its functions are given, and their totals.

Tiles are shared out to threads. Each entry of the tile lists gets a row of its own, and the rows of a splat are added
up in the order of the lists, so that no bit depends on the number of threads.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pop_fast.compiled.compositing import aligned_records, blend_numbers
from pop_fast.compiled.library import MomentScores, PointScores, Scores, SensitivityScores, call_library, this_library
from pop_fast.compiled.splatting import colors_of_view, covariances, project
from pop_fast.stages.blend.pairs import background_or_black, check_grid
from pop_fast.stages.chord import DominantPoints, points_on_rays, towards_camera
from pop_fast.stages.compositing import BlendOptions
from pop_fast.stages.contributions import N_MOMENTS, Contributions, checked_map, three_channels
from pop_fast.stages.contributions import fisher_blocks as fisher_blocks_of_stages
from pop_fast.stages.projection import intrinsics
from pop_fast.stages.splatting import Splats, colors_of
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile


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


def dominant_points(
    splats: Splats,
    lists: TileLists,
    gaussians: Gaussians,
    camera: Camera,
    tile_size: int,
    profile: Profile = PAPER,
) -> DominantPoints:
    """See `pop_ref.chord.dominant_points`. A Gaussian with a scale of 0 does not compete.

    Optimizations: those of `pop_fast.stages.chord`; the walk through the lists is in C++ (`scores.h`).
    """
    width, height = camera.width, camera.height
    check_grid(lists, width, height, tile_size)
    like = splats.means2d
    ids = torch.empty((height, width), dtype=torch.int64)
    T_final = like.new_empty((height, width))
    fx, fy, cx, cy = intrinsics(camera.K, width, height, profile)
    rays = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    facing = towards_camera(gaussians, camera).to(like.dtype)
    results = {"dominant_ids": ids, "T_final": T_final}
    colors = like.new_empty((len(like), 0))
    scored(PointScores, splats, colors, lists, (width, height), profile, rays, facing=facing, **results)
    return DominantPoints(points_on_rays(ids, gaussians, camera, profile).to(like.dtype), ids, T_final)


def contributions(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    pixel_map: Tensor | None = None,
    profile: Profile = PAPER,
) -> Contributions:
    """See `pop_ref.contributions.contributions`. Optimizations: one blend without colours, in C++ (`scores.h`)."""
    check_grid(lists, width, height, tile_size)
    colors = splats.means2d.new_empty((len(splats.means2d), 0))
    pixel_map = checked_map(pixel_map, width, height, colors.dtype)
    found = totals(Scores, 4, splats, colors, lists, (width, height), profile, pixel_map=pixel_map)
    weight_sum, n_pixels, map_sum, distance_sum = found.T
    return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)


def sensitivities(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.sensitivity.sensitivities`. [N] float64

    Optimizations: the sum of the channels is blended as one, in C++, there and back (`scores.h`).
    """
    check_grid(lists, width, height, tile_size)
    colors = colors_of(splats)
    behind = background_or_black(background, colors).sum(0, keepdim=True)
    grey = colors.sum(1, keepdim=True)
    found = totals(SensitivityScores, 1, splats, grey, lists, (width, height), profile, background=behind)
    return found[:, 0] * splats.opacities.double().square()


def screen_moments(
    splats: Splats,
    lists: TileLists,
    width: int,
    height: int,
    tile_size: int,
    background: Tensor | None = None,
    profile: Profile = PAPER,
) -> Tensor:
    """See `pop_ref.fisher.screen_moments`. [N, 31] float64

    Optimizations: those of `pop_fast.stages.contributions.screen_moments`, in C++, there and back (`scores.h`).

    Raises:
        ValueError: there are not three channels, or the lists are not of that grid.
    """
    check_grid(lists, width, height, tile_size)
    colors = three_channels(splats)
    behind = background_or_black(background, colors)
    return totals(MomentScores, N_MOMENTS, splats, colors, lists, (width, height), profile, background=behind)


def fisher_blocks(
    gaussians: Gaussians, camera: Camera, moments: Tensor, sh_degree: int | None = None, profile: Profile = PAPER
) -> Tensor:
    """See `pop_ref.fisher.fisher_blocks`. [N, 6, 6] Optimizations: the compiled stages' transposes."""
    chain = {"project": project, "colors_of_view": colors_of_view, "covariances": covariances}
    return fisher_blocks_of_stages(gaussians, camera, moments, sh_degree, profile, **chain)
