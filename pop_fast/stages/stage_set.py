"""The stages of a backend on the CPU: functions that may each be torch's or compiled, and a view made of them.

`PassInput` and `Seen` are what a pass over a view is given, and what every backend's pass answers;
`pop_fast.density.passes` makes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from pop_fast.stages.compositing import Composite, composite
from pop_fast.stages.contributions import (
    Contributions,
    DominantPoints,
    contributions,
    dominant_points,
    fisher_blocks,
    screen_moments,
    sensitivities,
)
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of, colors_of_view, covariances, project
from pop_fast.stages.tiles import TileLists, tile_lists
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import Profile


@dataclass(frozen=True)
class Seen:
    """A view before its sums."""

    image: Tensor  # [H, W, 3]
    dominant_ids: Tensor  # -1 where none. [H, W]
    radii: Tensor  # [N, 2]
    depths: Tensor  # [N]


@dataclass(frozen=True)
class PassInput:
    """What a pass draws: Gaussians, a camera, the bands of their colours in use, and how."""

    gaussians: Gaussians  # activated
    camera: Camera  # the view
    sh_degree: int  # bands to use
    background: Tensor  # colour behind everything. [3]
    profile: Profile  # constants and strictness
    antialiased: bool  # scale opacities by the antialiasing factor


SMALL_TILE, LARGE_TILE = 8, 16  # px
SMALL_TILE_BELOW = 14.0  # px, root mean square extent of the visible splats; see benchmarks/NOTES.md


def torchs_tile(radii: Tensor) -> int:
    """Choose the tile that torch blends the cheapest, px, by extents [N, 2], px; the image does not depend on it."""
    visible = (radii > 0).all(1)
    area = (radii * visible[:, None]).to(torch.float64).prod(1).sum() / visible.sum().clamp_min(1)
    return SMALL_TILE if math.sqrt(float(area)) < SMALL_TILE_BELOW else LARGE_TILE


def large_tile(radii: Tensor) -> int:
    """Return the tile whose rows are one vector of the compiled blend, px; it passes over rows that a splat misses."""
    return LARGE_TILE


@dataclass(frozen=True)
class Stages:
    """Functions with the signatures and results of the torch path's, which are the defaults.

    It draws views as `pop_fast.api.backend.ViewStages` says.
    """

    covariances: Callable[..., Tensor] = covariances
    project: Callable[..., Splats] = project
    colors_of_view: Callable[..., Tensor] = colors_of_view
    list_tiles: Callable[..., TileLists] = tile_lists
    composite: Callable[..., Composite] = composite
    blend_tile: Callable[[Tensor], int] = torchs_tile  # given the splats' extents, the tile to blend them in
    contributions: Callable[..., Contributions] = contributions
    sensitivities: Callable[..., Tensor] = sensitivities
    screen_moments: Callable[..., Tensor] = screen_moments
    dominant_points: Callable[..., DominantPoints] = dominant_points

    def splats(
        self,
        means: Tensor,
        shapes: Any,
        opacities: Tensor,
        colors: Tensor,
        viewmat: Tensor,
        settings: ProjectionSettings,
        sh_degree: int | None,
    ) -> Splats:
        """Project Gaussians, and shade the visible ones."""
        made = self.project(means, shapes, opacities, viewmat, settings)
        if sh_degree is not None:
            visible = (made.radii > 0).all(1).nonzero().squeeze(1)
            colors = self.colors_of_view(colors, means, viewmat, sh_degree, visible)
        return replace(made, colors=colors)

    def blend(
        self,
        rows: Splats,
        seen: Splats,
        settings: ProjectionSettings,
        tile_size: int,
        background: Tensor | None,
        *,
        dominance: bool,
        counts: bool,
        absgrad_sink: Tensor | None,
    ) -> Composite:
        """List rows by tile and blend them.

        Counting visited entries needs the asked-for tiles and their full lists; without it, entries that reach no pixel
        are left out, and small splats are listed in small tiles.
        """
        own_tile = counts or settings.profile.extent == "square"
        lists = self.visible_lists(rows, settings, tile_size if own_tile else None, exact=not counts)
        made = self.composite(
            *(rows.means2d, rows.conics, rows.opacities, colors_of(rows), lists, settings.width, settings.height),
            settings.profile,
            dominance=dominance,
            counts=counts,
            absgrad_sink=absgrad_sink,
        )
        if background is None:
            return made
        return replace(made, image=made.image + (1.0 - made.alphas)[..., None] * background)

    def visible_lists(
        self, rows: Splats, settings: ProjectionSettings, tile_size: int | None, exact: bool = True
    ) -> TileLists:
        """List rows in tiles of that size, None for the cheapest, if `exact` without entries that reach no pixel."""
        shape = {"conics": rows.conics.detach(), "opacities": rows.opacities.detach()} if exact else {}
        size = self.blend_tile(rows.radii) if tile_size is None else tile_size
        place = (rows.means2d.detach(), rows.radii, rows.depths.detach(), settings.width, settings.height)
        return self.list_tiles(*place, size, settings.profile, **shape)

    def tile_lists(self, rows: Splats, settings: ProjectionSettings, tile_size: int) -> TileLists:
        # torch's, whatever blends: what meta shows is the same of all backends on the CPU
        place = (rows.means2d.detach(), rows.radii, rows.depths.detach(), settings.width, settings.height)
        return tile_lists(*place, tile_size, settings.profile)

    def counts_entries(self, tile_size: int) -> bool:
        return True


@dataclass(frozen=True)
class StagesView:
    """A shot that has been projected and listed: splats with colours, and lists without entries that reach no pixel."""

    shot: PassInput
    stages: Stages
    splats: Splats
    lists: TileLists

    def seen(self) -> Seen:
        s, camera, background = self.splats, self.shot.camera, self.shot.background
        blend = self.stages.composite(
            *(s.means2d, s.conics, s.opacities, colors_of(s), self.lists, camera.width, camera.height),
            self.shot.profile,
            dominance=True,
        )
        assert blend.dominant_ids is not None
        image = blend.image + (1.0 - blend.alphas)[..., None] * background
        return Seen(image, blend.dominant_ids, s.radii, s.depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        """As `pop_fast.stages.contributions.contributions`."""
        camera = self.shot.camera
        size = (camera.width, camera.height, self.lists.tile_size)
        return self.stages.contributions(self.splats, self.lists, *size, pixel_map, self.shot.profile)

    def sensitivities(self) -> Tensor:
        """As `pop_fast.stages.contributions.sensitivities`."""
        return self.stages.sensitivities(*self._blended())

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.contributions.fisher_blocks`, of its own screen moments."""
        stages, shot = self.stages, self.shot
        chain = {"project": stages.project, "colors_of_view": stages.colors_of_view, "covariances": stages.covariances}
        return fisher_blocks(shot.gaussians, shot.camera, self._moments(), shot.sh_degree, shot.profile, **chain)

    def dominant_points(self) -> DominantPoints:
        """As `pop_fast.stages.contributions.dominant_points`."""
        shot, size = self.shot, self.lists.tile_size
        return self.stages.dominant_points(self.splats, self.lists, shot.gaussians, shot.camera, size, shot.profile)

    def _moments(self) -> Tensor:
        return self.stages.screen_moments(*self._blended())

    def _blended(self) -> tuple[object, ...]:
        shot, size = self.shot, self.lists.tile_size
        return self.splats, self.lists, shot.camera.width, shot.camera.height, size, shot.background, shot.profile


def view_of(shot: PassInput, stages: Stages) -> StagesView:
    """Project and list a shot."""
    g, camera, profile = shot.gaussians, shot.camera, shot.profile
    settings = ProjectionSettings(camera.K, camera.width, camera.height, profile, shot.antialiased)
    shapes = stages.covariances(g.quats, g.scales)
    splats = stages.splats(g.means, shapes, g.opacities, g.sh, camera.viewmat, settings, shot.sh_degree)
    # in the profile whose square cuts visible alpha off, the grid is part of the meaning
    size = profile.tile_size if profile.extent == "square" else None
    return StagesView(shot, stages, splats, stages.visible_lists(splats, settings, size))
