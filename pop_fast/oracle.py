"""The oracle as stages of a view, which are autograd functions on tensors, and as a pass over one.

It is slow and exact, for small scenes and for comparison: tensors go in and come out in their own precision, and every
stage computes in float64.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pop_fast.stages.compositing import Composite
from pop_fast.stages.contributions import Contributions, DominantPoints
from pop_fast.stages.splatting import ProjectionSettings, Shapes, Splats, colors_of
from pop_fast.stages.stage_set import PassInput, Seen
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import once_differentiable
from pop_ref import compositing, splatting
from pop_ref.chord import dominant_points
from pop_ref.contributions import contributions
from pop_ref.fisher import fisher_blocks, screen_moments
from pop_ref.records import Camera, Gaussians
from pop_ref.records import Splats as OracleSplats
from pop_ref.render import render
from pop_ref.sensitivity import sensitivities
from pop_ref.tiles import tile_lists


class OracleStages:
    """Draws views as `pop_fast.api.backend.ViewStages` says."""

    def covariances(self, quats: Tensor, scales: Tensor) -> Shapes:
        """Return both as they are: the oracle makes covariances where it projects."""
        return Shapes(quats, scales)

    def splats(
        self,
        means: Tensor,
        shapes: Shapes,
        opacities: Tensor,
        colors: Tensor,
        viewmat: Tensor,
        settings: ProjectionSettings,
        sh_degree: int | None,
    ) -> Splats:
        made = _Project.apply(means, *shapes, opacities, colors, viewmat, settings, sh_degree)
        means2d, depths, conics, blended, shaded, radii = made
        return Splats(means2d, depths, conics, blended, radii, colors=shaded)

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
        colors = colors_of(rows)
        behind = colors.new_zeros(colors.shape[1]) if background is None else background
        place = (rows.depths.detach(), rows.radii, settings, tile_size, absgrad_sink)
        made = _Blend.apply(rows.means2d, rows.conics, rows.opacities, colors, behind, *place)
        image, alphas, ids, weights, blended, traversed = made
        return Composite(image, alphas, ids, weights, blended, traversed, None)

    def tile_lists(self, rows: Splats, settings: ProjectionSettings, tile_size: int) -> TileLists:
        width, height = settings.width, settings.height
        return TileLists.of(_lists(_records(rows), settings, tile_size), width, height, tile_size)

    def counts_entries(self, tile_size: int) -> bool:
        return True


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, colors, viewmat, settings, sh_degree = inputs
        given = None if sh_degree is not None else _array(colors)
        sh = _array(colors) if given is None else np.zeros((len(means), 1, 3))
        gaussians = Gaussians(_array(means), _array(quats), _array(scales), _array(opacities), sh)
        camera = Camera(_array(viewmat), _array(settings.K), settings.width, settings.height)
        ctx.of = (gaussians, camera)
        how = {"profile": settings.profile, "antialiased": settings.antialiased}
        ctx.options = {"sh_degree": sh_degree, "colors": given, **how}
        ctx.like = means
        made = splatting.project(gaussians, camera, **ctx.options)
        radii = torch.as_tensor(made.radii, dtype=torch.int32)
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(True)
        floats = (made.means2d, made.depths, made.conics, made.opacities, made.colors)
        return (*(torch.as_tensor(x, dtype=means.dtype) for x in floats), radii)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *cotangents: Any) -> tuple[Tensor | None, ...]:
        v_means2d, v_depths, v_conics, v_opacities, v_colors = (_array(v) for v in cotangents[:5])
        gaussians, camera = ctx.of
        v = splatting.project_vjp(
            gaussians, camera, v_means2d, v_conics, v_opacities, v_colors, v_depths, **ctx.options
        )
        of_colors = v.sh if v.colors is None else v.colors
        parts = (v.means, v.quats, v.scales, v.opacities, of_colors, v.viewmat)
        return (*(torch.as_tensor(part, dtype=ctx.like.dtype) for part in parts), None, None)


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        means2d, conics, opacities, colors, background, depths, radii, settings, tile_size, sink = inputs
        rows = _records(Splats(means2d, depths, conics, opacities, radii, colors=colors))
        lists = _lists(rows, settings, tile_size)
        size = {"width": settings.width, "height": settings.height, "tile_size": tile_size}
        ctx.of = {"splats": rows, "lists": lists, **size}
        ctx.behind, ctx.profile, ctx.sink, ctx.dtype = _array(background), settings.profile, sink, colors.dtype
        made = compositing.composite(**ctx.of, background=ctx.behind, profile=settings.profile)
        ids = torch.as_tensor(made.dominant_ids)
        weights = torch.as_tensor(made.dominant_weights, dtype=colors.dtype)
        counted = [torch.as_tensor(n, dtype=torch.int32) for n in (made.n_blended, made.n_traversed)]
        ctx.mark_non_differentiable(ids, weights, *counted)
        ctx.set_materialize_grads(True)
        image, alphas = (torch.as_tensor(x, dtype=colors.dtype) for x in (made.image, 1.0 - made.T_final))
        return (image, alphas, ids, weights, *counted)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_image: Tensor, v_alphas: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        options = {"v_T_final": -_array(v_alphas), "background": ctx.behind, "profile": ctx.profile}
        v = compositing.composite_vjp(**ctx.of, v_image=_array(v_image), **options)
        if ctx.sink is not None:
            ctx.sink.add_(torch.as_tensor(v.v_means2d_abs, dtype=ctx.sink.dtype))
        parts = (v.v_means2d, v.v_conics, v.v_opacities, v.v_colors, v.v_background)
        return (*(torch.as_tensor(part, dtype=ctx.dtype) for part in parts), None, None, None, None, None)


def _records(rows: Splats) -> OracleSplats:
    return OracleSplats(
        means2d=_array(rows.means2d),
        depths=_array(rows.depths),
        conics=_array(rows.conics),
        opacities=_array(rows.opacities),
        colors=_array(colors_of(rows)),
        radii=rows.radii.numpy().astype(np.int64),
    )


def _lists(rows: OracleSplats, settings: ProjectionSettings, tile_size: int) -> list[list[int]]:
    size = (settings.width, settings.height, tile_size)
    return tile_lists(rows.means2d, rows.radii, rows.depths, *size, settings.profile)


def _array(tensor: Tensor) -> np.ndarray:
    # a copy: the way back may come after the caller has written to the tensor
    return tensor.detach().cpu().numpy().astype(np.float64)


class OracleView:
    """A shot that has been drawn."""

    def __init__(self, shot: PassInput) -> None:
        g, c = shot.gaussians, shot.camera
        self._gaussians = Gaussians(*(_array(t) for t in (g.means, g.quats, g.scales, g.opacities, g.sh)))
        self._camera = Camera(_array(c.viewmat), _array(c.K), c.width, c.height)
        self._background, self._dtype, self._shot = _array(shot.background), g.means.dtype, shot
        how = {name: getattr(shot, name) for name in ("sh_degree", "profile", "antialiased")}
        self._render = render(self._gaussians, self._camera, background=self._background, **how)

    def seen(self) -> Seen:
        made = self._render
        radii = torch.as_tensor(made.splats.radii, dtype=torch.int32)
        depths = self._floats(made.splats.depths)
        return Seen(self._floats(made.image), torch.as_tensor(made.dominant_ids), radii, depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        given = None if pixel_map is None else _array(pixel_map)
        made = contributions(*self._listed(), given, self._shot.profile)
        found = (made.weight_sum, made.n_pixels, made.map_sum, made.distance_sum)
        return Contributions(*(torch.as_tensor(sums) for sums in found))

    def sensitivities(self) -> Tensor:
        return torch.as_tensor(sensitivities(*self._listed(), self._background, self._shot.profile))

    def fisher_blocks(self) -> Tensor:
        moments = screen_moments(*self._listed(), self._background, self._shot.profile)
        shot = self._shot
        return torch.as_tensor(fisher_blocks(self._gaussians, self._camera, moments, shot.sh_degree, shot.profile))

    def dominant_points(self) -> DominantPoints:
        made, profile = self._render, self._shot.profile
        found = dominant_points(made.splats, made.tile_lists, self._gaussians, self._camera, profile.tile_size, profile)
        return DominantPoints(self._floats(found.points), torch.as_tensor(found.ids), self._floats(found.T_final))

    def _listed(self) -> tuple[OracleSplats, list[list[int]], int, int, int]:
        made, camera = self._render, self._camera
        return made.splats, made.tile_lists, camera.width, camera.height, self._shot.profile.tile_size

    def _floats(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=self._dtype)
