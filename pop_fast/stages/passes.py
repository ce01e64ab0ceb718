"""A pass over a view by the stages of a CPU backend."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pop_fast.stages.chord import DominantPoints
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.fisher import fisher_blocks
from pop_fast.stages.splatting import ProjectionSettings, Splats, colors_of
from pop_fast.stages.stage_set import Stages
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.view_pass import PassInput, Seen


@dataclass(frozen=True)
class StagesView:
    """A shot that has been projected and listed.

    Attributes:
        shot: what is drawn.
        stages: of the backend.
        splats: with colours.
        lists: without the entries that reach no pixel.
    """

    shot: PassInput
    stages: Stages
    splats: Splats
    lists: TileLists

    def seen(self) -> Seen:
        """Draw it."""
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
        """As `pop_fast.stages.sensitivity.sensitivities`."""
        return self.stages.sensitivities(*self._blended())

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.fisher.fisher_blocks`, of its own screen moments."""
        stages, shot = self.stages, self.shot
        chain = {"project": stages.project, "colors_of_view": stages.colors_of_view, "covariances": stages.covariances}
        return fisher_blocks(shot.gaussians, shot.camera, self._moments(), shot.sh_degree, shot.profile, **chain)

    def dominant_points(self) -> DominantPoints:
        """As `pop_fast.stages.chord.dominant_points`."""
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
