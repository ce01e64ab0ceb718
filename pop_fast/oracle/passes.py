"""A pass over a view by the oracle: slow, exact, float64, for small scenes and for comparison."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from pop_fast.stages.chord import DominantPoints
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.stage_set import PassInput, Seen
from pop_ref.chord import dominant_points
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments
from pop_ref.records import Camera, Gaussians, Splats
from pop_ref.render import render
from pop_ref.sensitivity import sensitivities


class OracleView:
    """A shot that has been drawn.

    Args:
        shot: what is drawn.
    """

    def __init__(self, shot: PassInput) -> None:
        g, c = shot.gaussians, shot.camera
        self._gaussians = Gaussians(*(_array(t) for t in (g.means, g.quats, g.scales, g.opacities, g.sh)))
        self._camera = Camera(_array(c.viewmat), _array(c.K), c.width, c.height)
        self._background, self._dtype, self._shot = _array(shot.background), g.means.dtype, shot
        self._render = render(
            self._gaussians,
            self._camera,
            sh_degree=shot.sh_degree,
            background=self._background,
            profile=shot.profile,
            antialiased=shot.antialiased,
        )

    def seen(self) -> Seen:
        """Return the drawing."""
        made = self._render
        radii = torch.as_tensor(made.splats.radii, dtype=torch.int32)
        depths = self._floats(made.splats.depths)
        return Seen(self._floats(made.image), torch.as_tensor(made.dominant_ids), radii, depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        """See `pop_ref.contributions.contributions`."""
        given = None if pixel_map is None else _array(pixel_map)
        made = contributions(*self._listed(), given, self._shot.profile)
        found = (made.weight_sum, made.n_pixels, made.map_sum, made.distance_sum)
        return Contributions(*(torch.as_tensor(sums) for sums in found))

    def sensitivities(self) -> Tensor:
        """See `pop_ref.sensitivity.sensitivities`."""
        return torch.as_tensor(sensitivities(*self._listed(), self._background, self._shot.profile))

    def fisher_blocks(self) -> Tensor:
        """See `pop_ref.fisher.fisher_blocks`."""
        moments = screen_moments(*self._listed(), self._background, self._shot.profile)
        shot = self._shot
        return torch.as_tensor(fisher_blocks(self._gaussians, self._camera, moments, shot.sh_degree, shot.profile))

    def dominant_points(self) -> DominantPoints:
        """See `pop_ref.chord.dominant_points`."""
        made, profile = self._render, self._shot.profile
        found = dominant_points(made.splats, made.tile_lists, self._gaussians, self._camera, profile.tile_size, profile)
        return DominantPoints(self._floats(found.points), torch.as_tensor(found.ids), self._floats(found.T_final))

    def _listed(self) -> tuple[Splats, list[list[int]], int, int, int]:
        made, camera = self._render, self._camera
        return made.splats, made.tile_lists, camera.width, camera.height, self._shot.profile.tile_size

    def _floats(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self._dtype)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.double().cpu().numpy()
