"""Where a pixel's ray is closest to the Gaussian that it belongs to (Mini-Splatting). See `pop_ref.chord`.

Whether a Gaussian is densest ahead of the camera, t* >= 0, has the sign of -(a . b) with a = diag(1/s) R^T (o - mean)
and b = diag(1/s) R^T d. So a pair needs g . d <= 0 only, with g = R diag(1/s) a made once a Gaussian; t* is computed
for the winner of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pop_fast.stages.blend.pairs import PairWalk, check_grid
from pop_fast.stages.covariance import rotmats_from_quats
from pop_fast.stages.projection import camera_center, intrinsics
from pop_fast.stages.splatting import Splats
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import PAPER, Profile


@dataclass(frozen=True)
class DominantPoints:
    """See `pop_ref.chord.DominantPoints`.

    Attributes:
        points: on the rays, world units; 0 where no Gaussian competes. [H, W, 3]
        ids: the Gaussian of each pixel, -1 where none competes. [H, W] int64
        T_final: light that is left behind all that is blended. [H, W]
    """

    points: Tensor
    ids: Tensor
    T_final: Tensor


def chord_midpoint(mean: Tensor, quat: Tensor, scale: Tensor, origin: Tensor, direction: Tensor) -> Tensor:
    """See `pop_ref.chord.chord_midpoint`. Optimizations: any leading axes. [...]"""
    a = _whitened(quat, scale, origin - mean)
    b = _whitened(quat, scale, direction)
    return -(a * b).sum(-1) / (b * b).sum(-1)


def _whitened(quat: Tensor, scale: Tensor, vector: Tensor) -> Tensor:
    """Return diag(1/s) R^T v. [..., 3]"""
    R = rotmats_from_quats(quat.reshape(-1, 4)).reshape(*quat.shape[:-1], 3, 3)
    return (R * vector[..., :, None]).sum(-2) / scale


def dominant_points(
    splats: Splats,
    lists: TileLists,
    gaussians: Gaussians,
    camera: Camera,
    tile_size: int,
    profile: Profile = PAPER,
) -> DominantPoints:
    """See `pop_ref.chord.dominant_points`. A Gaussian with a scale of 0 does not compete.

    Optimizations: see the module's text; a group of tiles and a block of list entries at a time (`pairs`).
    """
    check_grid(lists, camera.width, camera.height, tile_size)
    walk = PairWalk(splats, lists, camera.width, camera.height, profile)
    dtype = splats.means2d.dtype
    facing = torch.cat((towards_camera(gaussians, camera), torch.zeros((1, 3), dtype=torch.float64))).to(dtype)
    directions = walk.tiles_of(ray_directions(camera, profile).to(dtype))
    best, T = directions.new_zeros(len(directions), directions.shape[2]), directions.new_ones(directions[:, 0].shape)
    ids = torch.full(best.shape, -1)
    for pairs in walk.front_to_back():
        torch.bmm(facing[pairs.ids], directions.index_select(0, pairs.tiles), out=pairs.scratch)
        competing = pairs.scratch.le_(0.0).mul_(pairs.weight)
        largest, place = competing.max(1)
        before = best.index_select(0, pairs.tiles)
        # strictly larger: on equal weights the entry in front keeps the pixel (D8)
        wins = largest > before
        best.index_copy_(0, pairs.tiles, torch.where(wins, largest, before))
        winners = pairs.ids.gather(1, place)
        ids.index_copy_(0, pairs.tiles, torch.where(wins, winners, ids.index_select(0, pairs.tiles)))
        T.index_copy_(0, pairs.tiles, T.index_select(0, pairs.tiles) * (1.0 - pairs.alpha).prod(1))
    winner = walk.image_of(ids)
    return DominantPoints(points_on_rays(winner, gaussians, camera, profile).to(dtype), winner, walk.image_of(T))


def towards_camera(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return g in the camera's axes: t* of a ray d has the sign of -(g . d), nan where a scale is 0. [N, 3] float64"""
    means, quats, scales = (t.double() for t in (gaussians.means, gaussians.quats, gaussians.scales))
    viewmat = camera.viewmat.double()
    a = _whitened(quats, scales, camera_center(viewmat) - means)
    g = (rotmats_from_quats(quats) * (a / scales)[:, None, :]).sum(2)
    flat = (scales == 0.0).any(1, keepdim=True)
    return (g @ viewmat[:3, :3].T).masked_fill(flat, torch.nan)


def ray_directions(camera: Camera, profile: Profile) -> Tensor:
    """Return where the rays through the pixels' centres point, in the camera's axes, z being 1. [H, W, 3] float64"""
    fx, fy, cx, cy = intrinsics(camera.K, camera.width, camera.height, profile)
    like = {"dtype": torch.float64, "device": camera.K.device}
    x = (torch.arange(camera.width, **like) + (0.5 - cx)) / fx
    y = (torch.arange(camera.height, **like) + (0.5 - cy)) / fy
    across, down = torch.meshgrid(x, y, indexing="xy")
    return torch.stack((across, down, torch.ones_like(down)), 2)


def points_on_rays(ids: Tensor, gaussians: Gaussians, camera: Camera, profile: Profile) -> Tensor:
    """Return the point at t* of each pixel's Gaussian, 0 where the pixel has none. [H, W, 3] float64

    Args:
        ids: -1 for none. [H, W]
        gaussians: in the world.
        camera: the view.
        profile: which principal point is used.
    """
    viewmat = camera.viewmat.double()
    found = ids >= 0
    chosen = ids[found]
    directions = torch.nn.functional.normalize(ray_directions(camera, profile)[found], dim=1) @ viewmat[:3, :3]
    means, quats, scales = (t.double()[chosen] for t in (gaussians.means, gaussians.quats, gaussians.scales))
    origin = camera_center(viewmat)
    t = chord_midpoint(means, quats, scales, origin, directions)
    points = viewmat.new_zeros((*ids.shape, 3))
    points[found] = origin + t[:, None] * directions
    return points
