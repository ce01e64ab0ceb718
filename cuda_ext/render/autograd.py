"""The two autograd functions behind `rasterization`: Gaussians to splats, and splats to an image."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import Settings, empty, fill, stream_of
from cuda_ext.render.lists import LOWER, TileBuffers, splat_struct


def _transpose(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Make a transpose run with its tensors' device as the current one, on which kernels run, whoever calls it.

    It refuses to be differentiated, with a RuntimeError.
    """

    @functools.wraps(backward)
    def there(ctx: Any, *cotangents: Any) -> Any:
        if torch.is_grad_enabled():
            raise RuntimeError("there are no second derivatives here; take gradients without create_graph=True")
        with torch.cuda.device_of(next(v for v in cotangents if v is not None)):
            return backward(ctx, *cotangents)

    return there


def _gaussian_struct(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor | None) -> Any:
    made = fill(
        load().Gaussians(), n=len(means), means=means, quats=quats, scales=scales, opacities=opacities, raw=False
    )
    if sh is not None:
        fill(made, sh_first=sh, sh_first_stride=3 * sh.shape[1])
    return made


class Project(torch.autograd.Function):
    """Gaussians of one scene and one camera to splats; `sh` may be None where colours are given."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, ...]:
        means, quats, scales, opacities, sh, viewmat, K, settings, state = inputs
        kernels, n, device = load(), len(means), means.device
        tensors = [None if t is None else t.detach().contiguous() for t in (means, quats, scales, opacities, sh)]
        pose, intrinsics = viewmat.detach().contiguous(), K.detach().contiguous()
        means2d, depths = means.new_empty((n, 2)), means.new_empty((n,))
        conics, blended = means.new_empty((n, 3)), means.new_empty((n,))
        radii = torch.empty((n, 2), dtype=torch.int32, device=device)
        colors = means.new_empty((n, 3)) if sh is not None else None
        view = fill(kernels.View(), viewmat=pose, K=intrinsics, width=settings.width, height=settings.height)
        splats = splat_struct(means2d, depths, conics, blended, radii, colors)
        gaussians = _gaussian_struct(*tensors)  # type: ignore[arg-type]
        kernels.project(gaussians, view, settings.project_settings(), splats, state.data_ptr(), stream_of(device))
        ctx.settings, ctx.has_sh = settings, sh is not None
        ctx.save_for_backward(*tensors, pose, intrinsics, radii)
        ctx.mark_non_differentiable(radii)
        return means2d, depths, conics, blended, radii, means.new_empty((n, 0)) if colors is None else colors

    @staticmethod
    @_transpose
    def backward(ctx: Any, *cotangents: Any) -> tuple[Tensor | None, ...]:
        v_means2d, v_depths, v_conics, v_opacities, _, v_colors = cotangents
        means, quats, scales, opacities, sh, viewmat, K, radii = ctx.saved_tensors
        kernels, n, device, settings = load(), len(means), means.device, ctx.settings

        def given(v: Tensor | None, *like: int) -> Tensor:
            return means.new_zeros(like) if v is None else v.contiguous()

        of = {"v_means2d": given(v_means2d, n, 2), "v_conics": given(v_conics, n, 3)}
        of |= {"v_opacities": given(v_opacities, n), "v_colors": given(v_colors, n, 3) if ctx.has_sh else None}
        depths = given(v_depths, n)
        rows = {"v_means": means, "v_quats": quats, "v_scales": scales, "v_opacities": opacities, "v_sh": sh}
        found = {name: None if like is None else torch.empty_like(like) for name, like in rows.items()}
        blocks = -(-n // kernels.PROJECT_BLOCK)
        partials = means.new_zeros((max(blocks, 1), 12)) if ctx.needs_input_grad[5] else None
        gradients = fill(kernels.GaussianGradients(), **found, v_viewmat=partials)
        gradients.sh_stride = 3 * sh.shape[1] if ctx.has_sh else 0
        view = fill(kernels.View(), viewmat=viewmat, K=K, width=settings.width, height=settings.height)
        kernels.project_backward(
            _gaussian_struct(means, quats, scales, opacities, sh),
            view,
            settings.project_settings(),
            fill(kernels.Splats(), radii=radii),
            fill(kernels.SplatGradients(), **of),
            depths.data_ptr(),
            gradients,
            stream_of(device),
        )
        v_viewmat = None
        if partials is not None:
            upper = partials.sum(0)
            v_viewmat = means.new_zeros((4, 4))
            v_viewmat[:3, :3] = upper[:9].reshape(3, 3)
            v_viewmat[:3, 3] = upper[9:]
        return (*found.values(), v_viewmat, None, None, None)


@dataclass(frozen=True)
class RenderStats:
    """What the telling instantiation of the blend found; ids index the rows that were blended."""

    dominant_ids: Tensor  # int32, -1 where none. [H, W]
    dominant_weights: Tensor  # [H, W]
    # int32. [H, W]
    n_blended: Tensor
    n_traversed: Tensor
    dominant_counts: Tensor  # int32. [N]


class BlendBuffers:
    """One forward blend and what its transpose needs."""

    def __init__(
        self, rows: tuple[Tensor, ...], background: Tensor | None, buffers: TileBuffers, settings: Settings
    ) -> None:
        means2d, conics, opacities, colors = rows
        kernels, device, n = load(), means2d.device, len(means2d)
        H, W, self.channels = settings.height, settings.width, colors.shape[1]
        self.rows, self.background, self.buffers, self.settings = rows, background, buffers, settings
        # only lists of the warps' own tiles are numbered in buckets; the others go back column by column
        self.gaussian_parallel = settings.backward == "gaussian_parallel" and buffers.buckets
        self.records = empty("packed splats", LOWER, (max(n, 1), kernels.RECORD), device)
        self.splats = fill(kernels.Splats(), means2d=means2d, conics=conics, opacities=opacities, colors=colors)
        floor = settings.profile.alpha_floor
        kernels.pack_records(n, self.channels, self.splats, floor, self.records.data_ptr(), stream_of(device))
        self.image = empty("the image", "the image size", (H, W, self.channels), device)
        self.T_final = empty("the image", "the image size", (H, W), device)
        self.last = empty("the image", "the image size", (H, W), device, torch.int32)
        self.checkpoints: Tensor | None = None
        if self.gaussian_parallel:
            shape = (buffers.max_buckets, 1 + self.channels, kernels.TILE_PIXELS)
            self.checkpoints = empty("checkpoints", LOWER + ", or use backward='pixel_parallel'", shape, device)

    def run(self, stats: RenderStats | None) -> None:
        kernels = load()
        blend = fill(kernels.BlendForward(), **self._both())
        if stats is not None:
            fill(blend, **stats.__dict__)
        stream = stream_of(self.image.device)
        kernels.blend_forward(self.buffers.struct, blend, self.settings.kernel_profile(), stream)

    def _both(self) -> dict[str, Any]:
        """Return what both directions take, by the kernels' names."""
        names = ("channels", "records", "background", "image", "T_final", "last", "checkpoints")
        return {name: getattr(self, name) for name in names}

    def backward(self, v_image: Tensor, v_T_final: Tensor | None, state: Tensor) -> dict[str, Tensor | None]:
        kernels, device, n = load(), self.image.device, len(self.rows[0])
        slots = self.settings.deterministic
        size = (max(n, 1), kernels.RECORD)
        sums = empty("gradient sums", LOWER, size, device) if slots else torch.zeros(size, device=device)
        rows = None
        if slots:
            shape = (self.buffers.capacity * self.buffers.parts, kernels.RECORD)
            rows = empty("gradient slots", LOWER + ", or use deterministic=False", shape, device)
        blend = fill(kernels.BlendBackward(), **self._both(), absolute=self.settings.absgrad, v_image=v_image)
        fill(blend, v_T_final=v_T_final, rows=rows, sums=sums)
        blend.set_backward(self.gaussian_parallel, not slots)
        stream, profile = stream_of(device), self.settings.kernel_profile()
        kernels.blend_backward(self.buffers.struct, blend, profile, state.data_ptr(), stream)
        found: dict[str, Tensor | None] = {
            "v_means2d": torch.empty_like(self.rows[0]),
            "v_means2d_abs": torch.empty_like(self.rows[0]) if self.settings.absgrad else None,
            "v_conics": torch.empty_like(self.rows[1]),
            "v_opacities": torch.empty_like(self.rows[2]),
            "v_colors": torch.empty_like(self.rows[3]),
        }
        gradients = fill(kernels.SplatGradients(), **found)
        kernels.splat_gradients(n, self.channels, self.splats, sums.data_ptr(), gradients, stream)
        return found


class Blend(torch.autograd.Function):
    """Splats to an image over a background; returns the image and the remaining transmittance."""

    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:
        means2d, conics, opacities, colors, background, buffers, settings, state, stats, sink = inputs
        rows = tuple(t.detach().contiguous() for t in (means2d, conics, opacities, colors))
        # a copy: the caller may have written to it before the way back
        behind = None if background is None else background.detach().clone(memory_format=torch.contiguous_format)
        blended = BlendBuffers(rows, behind, buffers, settings)
        blended.run(stats)
        ctx.blended, ctx.state, ctx.sink = blended, state, sink
        # aliases: an output that its own graph node holds would never be freed
        return blended.image.detach(), blended.T_final.detach()

    @staticmethod
    @_transpose
    def backward(ctx: Any, *cotangents: Any) -> tuple[Tensor | None, ...]:
        v_image, v_T_final = cotangents
        blended = ctx.blended
        v_image = torch.zeros_like(blended.image) if v_image is None else v_image.contiguous()
        v_T = None if v_T_final is None else v_T_final.contiguous()
        found = blended.backward(v_image, v_T, ctx.state)
        if ctx.sink is not None:
            ctx.sink.add_(found["v_means2d_abs"])
        v_background = (blended.T_final[..., None] * v_image).sum((0, 1)) if ctx.needs_input_grad[4] else None
        of_rows = (found["v_means2d"], found["v_conics"], found["v_opacities"], found["v_colors"])
        return (*of_rows, v_background, None, None, None, None, None)
