"""Passes over one view on the GPU: its image, sums over the pixels of every Gaussian, what its pixels belong to."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import Settings, check_tensor, empty, fill, new_state, stream_of
from cuda_ext.render.autograd import BlendBuffers, Project, RenderStats
from cuda_ext.render.lists import LOWER, list_tile, make_lists, splat_struct
from pop_ref.constants import Profile

# values of Score (csrc/launch.h)
CONTRIBUTIONS, SENSITIVITIES, MOMENTS, POINTS = range(4)


class ScoredView:
    """A view that has been projected, listed and drawn.

    Args:
        gaussians: means [N, 3], quats [N, 4], scales [N, 3] and opacities [N], activated, and sh [N, n_sh, 3].
        viewmat: world -> camera. [4, 4]
        K: intrinsics, px. [3, 3]
        width, height: px.
        sh_degree: bands to use.
        background: colour behind everything. [3]
        profile: constants and strictness.
        antialiased: scale opacities by the antialiasing factor.

    Attributes:
        image: [H, W, 3]
        T_final: [H, W]
        dominant_ids: -1 where none. [H, W] int32
        radii: extents, px; 0 where culled. [N, 2] int32
        depths: camera z, world units. [N]

    Raises:
        ValueError: an input's shape, type or place is wrong, or a Gaussian projects to what is not finite.
        CudaMemoryError: the GPU has no room.
    """

    def __init__(
        self,
        gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor],
        viewmat: Tensor,
        K: Tensor,
        width: int,
        height: int,
        sh_degree: int,
        background: Tensor,
        profile: Profile,
        antialiased: bool,
    ) -> None:
        n, of = len(gaussians[0]), ("means", "quats", "scales", "opacities")
        for name, tensor, shape in zip(of, gaussians, ((n, 3), (n, 4), (n, 3), (n,)), strict=False):
            check_tensor(name, tensor, shape)
        check_tensor("sh", gaussians[4], (n, gaussians[4].shape[1], 3))
        check_tensor("viewmat", viewmat, (4, 4))
        check_tensor("K", K, (3, 3))
        self._background = check_tensor("background", background, (3,)).contiguous()
        self._settings = Settings(width, height, profile, profile.tile_size, sh_degree, antialiased)
        with torch.cuda.device_of(viewmat), torch.no_grad():
            self._draw(gaussians, viewmat, K)

    def _draw(self, gaussians: tuple[Tensor, ...], viewmat: Tensor, K: Tensor) -> None:
        settings, device = self._settings, viewmat.device
        state = new_state(device)
        made = Project.apply(*gaussians, viewmat, K, settings, state)
        self._means2d, self.depths, self._conics, self._opacities, self.radii, self._colors = made
        splats = splat_struct(self._means2d, self.depths, self._conics, self._opacities, self.radii, None)
        tile, exact = list_tile(settings, counted=False)
        self._buffers = make_lists(settings, splats, len(self.depths), device, tile, exact, state)
        rows = (self._means2d, self._conics, self._opacities, self._colors)
        self._blended = BlendBuffers(rows, self._background, self._buffers, settings)
        shape = (settings.height, settings.width)
        ids, blended, traversed = (torch.empty(shape, dtype=torch.int32, device=device) for _ in range(3))
        won = torch.zeros(max(len(self.depths), 1), dtype=torch.int32, device=device)
        weights = torch.empty(shape, device=device)
        self._blended.run(RenderStats(ids, weights, blended, traversed, won))
        self.image, self.T_final, self.dominant_ids = self._blended.image, self._blended.T_final, ids

    def contributions(self, pixel_map: Tensor | None) -> Tensor:
        """Sum T alpha, 1, a map [H, W] and the pixels' distances from the splat's centre. [N, 4] float64

        Raises:
            ValueError: the map is not of the view's size.
        """
        if pixel_map is not None:
            pixel_map = check_tensor("pixel_map", pixel_map, tuple(self.T_final.shape)).contiguous()
        nothing = self._colors.new_zeros((len(self._colors), 1))
        return self._totals(CONTRIBUTIONS, nothing, pixel_map=pixel_map)

    def sensitivities(self) -> Tensor:
        """Sum the squared slopes of pixels along every Gaussian's value there. [N] float64"""
        behind = self._background.sum(0, keepdim=True)
        found = self._totals(SENSITIVITIES, self._colors.sum(1, keepdim=True), background=behind)
        return found[:, 0] * self._opacities.double().square()

    def screen_moments(self) -> Tensor:
        """Sum second moments of a pixel's derivatives by what the screen holds of a Gaussian. [N, 31] float64"""
        return self._totals(MOMENTS, self._colors, background=self._background)

    def dominant_of(self, facing: Tensor, rays: tuple[float, float, float, float]) -> Tensor:
        """Find the Gaussian of the largest weight of every pixel among those with `facing . d <= 0` there, -1 for none.

        Args:
            facing: in the camera's axes. [N, 3]
            rays: fx, fy, cx, cy, px; d is ((x - cx) / fx, (y - cy) / fy, 1).

        Returns:
            [H, W] int64
        """
        ids = torch.empty(self.T_final.shape, dtype=torch.int32, device=facing.device)
        fx, fy, cx, cy = rays
        self._run(POINTS, check_tensor("facing", facing, (len(self.depths), 3)), ids=ids, fx=fx, fy=fy, cx=cx, cy=cy)
        return ids.long()

    def _totals(self, score: int, colors: Tensor, **given: Any) -> Tensor:
        kernels, device, n = load(), colors.device, len(colors)
        columns, pitch = kernels.score_columns(score), kernels.score_pitch(score)
        shape = (self._buffers.capacity * self._buffers.parts, pitch)
        rows = empty("rows of sums", LOWER, shape, device).zero_()
        totals = torch.empty((n, columns), dtype=torch.float64, device=device)
        self._run(score, colors, rows=rows, totals=totals, **given)
        return totals

    def _run(self, score: int, colors: Tensor, **given: Any) -> None:
        kernels, settings, n = load(), self._settings, len(colors)
        with torch.cuda.device_of(colors):
            stream = stream_of(colors.device)
            records = empty("packed splats", LOWER, (max(n, 1), kernels.RECORD), colors.device)
            rows = {"means2d": self._means2d, "conics": self._conics, "opacities": self._opacities}
            splats = fill(kernels.Splats(), **rows, colors=colors.contiguous())
            floor = settings.profile.alpha_floor
            kernels.pack_records(n, colors.shape[1], splats, floor, records.data_ptr(), stream)
            drawn = {"T_final": self.T_final, "last": self._blended.last}
            scores = fill(kernels.Scores(), records=records, **drawn, **given)
            kernels.score_view(self._buffers.struct, scores, score, settings.kernel_profile(), stream)
