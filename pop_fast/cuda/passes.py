"""A pass over a view by the CUDA kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from cuda_ext.render.scores import ScoredView
from pop_fast.stages.chord import DominantPoints, points_on_rays, towards_camera
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.fisher import fisher_blocks
from pop_fast.stages.projection import intrinsics
from pop_fast.stages.types import Camera, Gaussians
from pop_fast.stages.view_pass import PassInput, Seen
from pop_fast.train.gpu_proxy import words_for_memory


class CudaView:
    """A shot that has been drawn on the GPU where its Gaussians lie.

    Args:
        shot: what is drawn.

    Raises:
        PopError: the GPU has no room; says what to lower.
    """

    def __init__(self, shot: PassInput) -> None:
        self._shot = shot
        g, c = shot.gaussians, shot.camera
        rows = (g.means, g.quats, g.scales, g.opacities, g.sh)
        with words_for_memory():
            self._view = ScoredView(
                rows, c.viewmat, c.K, c.width, c.height, shot.sh_degree, shot.background, shot.profile, shot.antialiased
            )

    def seen(self) -> Seen:
        """Return the drawing."""
        view = self._view
        return Seen(view.image, view.dominant_ids.long(), view.radii, view.depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        """As `pop_fast.stages.contributions.contributions`."""
        with words_for_memory():
            found = self._view.contributions(None if pixel_map is None else pixel_map.float())
        weight_sum, n_pixels, map_sum, distance_sum = found.T
        return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)

    def sensitivities(self) -> Tensor:
        """As `pop_fast.stages.sensitivity.sensitivities`."""
        with words_for_memory():
            return self._view.sensitivities()

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.fisher.fisher_blocks`, of its own screen moments; made on the CPU, in float64."""
        with words_for_memory():
            moments = self._view.screen_moments()
        shot = self._shot
        g, c = shot.gaussians, shot.camera
        gaussians = Gaussians(*(t.cpu() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)))
        camera = Camera(c.viewmat.cpu(), c.K.cpu(), c.width, c.height)
        blocks = fisher_blocks(gaussians, camera, moments.cpu(), shot.sh_degree, shot.profile)
        return blocks.to(moments.device)

    def dominant_points(self) -> DominantPoints:
        """As `pop_fast.stages.chord.dominant_points`."""
        shot = self._shot
        c = shot.camera
        rays = intrinsics(c.K, c.width, c.height, shot.profile)
        ids = self._view.dominant_of(towards_camera(shot.gaussians, c).float(), rays)
        points = points_on_rays(ids, shot.gaussians, c, shot.profile)
        return DominantPoints(points.float(), ids, self._view.T_final)
