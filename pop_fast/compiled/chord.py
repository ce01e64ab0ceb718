"""The points of a view's pixels, by the compiled library. Meaning: `pop_ref.chord`."""

from __future__ import annotations

import torch

from pop_fast.compiled.library import PointScores
from pop_fast.compiled.scores import scored
from pop_fast.stages.blend.pairs import check_grid
from pop_fast.stages.chord import DominantPoints, points_on_rays, towards_camera
from pop_fast.stages.projection import intrinsics
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile


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
