"""A pass over a view by the CUDA kernels."""

from __future__ import annotations

import torch
from torch import Tensor

from cuda_ext.render.scores import ScoredView
from pop_fast.stages.chord import DominantPoints, points_on_rays, towards_camera
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.fisher import fisher_blocks
from pop_fast.stages.projection import intrinsics
from pop_fast.stages.stage_set import PassInput, Seen
from pop_fast.stages.types import Camera, Gaussians
from pop_fast.train.gpu_proxy import translate_oom


class CudaView:
    """A shot that has been drawn on the GPU where its Gaussians lie.

    Args:
        pass_input: what is drawn.

    Raises:
        PopError: the GPU has no room; says what to lower.
    """

    def __init__(self, pass_input: PassInput) -> None:
        self._input = pass_input
        g, c = pass_input.gaussians, pass_input.camera
        rows = (g.means, g.quats, g.scales, g.opacities, g.sh)
        with translate_oom():
            self._view = ScoredView(
                rows,
                c.viewmat,
                c.K,
                c.width,
                c.height,
                pass_input.sh_degree,
                pass_input.background,
                pass_input.profile,
                pass_input.antialiased,
            )

    def seen(self) -> Seen:
        """Return the drawing."""
        view = self._view
        return Seen(view.image, view.dominant_ids.long(), view.radii, view.depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        """As `pop_fast.stages.contributions.contributions`."""
        with translate_oom():
            found = self._view.contributions(None if pixel_map is None else pixel_map.float())
        weight_sum, n_pixels, map_sum, distance_sum = found.T
        return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)

    def sensitivities(self) -> Tensor:
        """As `pop_fast.stages.sensitivity.sensitivities`."""
        with translate_oom():
            return self._view.sensitivities()

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.fisher.fisher_blocks`, of its own screen moments; made on the CPU, in float64."""
        with translate_oom():
            moments = self._view.screen_moments()
        pass_input = self._input
        g, c = pass_input.gaussians, pass_input.camera
        gaussians = Gaussians(*(t.cpu() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)))
        camera = Camera(c.viewmat.cpu(), c.K.cpu(), c.width, c.height)
        blocks = fisher_blocks(gaussians, camera, moments.cpu(), pass_input.sh_degree, pass_input.profile)
        return blocks.to(moments.device)

    def dominant_points(self) -> DominantPoints:
        """As `pop_fast.stages.chord.dominant_points`."""
        pass_input = self._input
        c = pass_input.camera
        rays = intrinsics(c.K, c.width, c.height, pass_input.profile)
        ids = self._view.dominant_of(towards_camera(pass_input.gaussians, c).float(), rays)
        points = points_on_rays(ids, pass_input.gaussians, c, pass_input.profile)
        return DominantPoints(points.float(), ids, self._view.T_final)
