"""The tensors behind a fused training step: of the whole training, of the present rows, of one image size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import STEP, Settings, empty, fill, new_state
from cuda_ext.render.capacity import Size
from cuda_ext.render.lists import LOWER, TileBuffers, list_tile, splat_struct
from cuda_ext.train_settings import KernelStatistics, StepSettings
from cuda_ext.training.resident import ResidentViews

Rows = Mapping[str, Tensor]


@dataclass(frozen=True)
class Shared:
    """What all steps of a training share.

    Attributes:
        settings: objective and update.
        views: the resident photographs and cameras.
        device: where everything is.
        state: the device's flags and counters.
        order: the view of every step.
        blur_pixels: of every view, the pixels that a blurred Gaussian dominates more than.
        background: colour behind everything, or None for black.
        viewmat, K: this step's camera.
        constants: this step's learning rates.
        rates, numbers: of every step, `Updates`.
        values: the statistics of the last step.
        history: the statistics of every step.
    """

    settings: StepSettings
    views: ResidentViews
    device: torch.device
    state: Tensor
    order: Tensor
    blur_pixels: Tensor
    background: Tensor | None
    viewmat: Tensor
    K: Tensor
    constants: Tensor
    rates: Tensor
    numbers: Tensor
    values: Tensor
    history: Tensor

    @classmethod
    def make(
        cls, settings: StepSettings, views: ResidentViews, order: Sequence[int], step: int, device: torch.device
    ) -> Shared:
        """Begin at a step."""
        kernels, state = load(), new_state(device)
        state[STEP] = step
        return cls(
            settings,
            views,
            device,
            state,
            torch.tensor(order, dtype=torch.int32, device=device),
            torch.tensor([settings.blur_pixels(kept) for kept in views.kept_pixels], device=device),
            torch.tensor(settings.background, device=device) if any(settings.background) else None,
            torch.zeros(16, device=device),
            torch.zeros(9, device=device),
            torch.zeros(kernels.STEP_CONSTANTS_FLOATS, device=device),
            settings.updates.rates.to(device),
            settings.updates.numbers.to(device),
            torch.zeros(kernels.N_VALUES, device=device),
            torch.zeros((len(settings.updates.rates), kernels.N_VALUES), device=device),
        )

    def render(self, size: Size, sh_degree: int) -> Settings:
        """Return what a render of that size depends on."""
        s = self.settings
        return Settings(*size, s.profile, s.profile.tile_size, sh_degree, s.antialiased, backward=s.backward)


@dataclass(frozen=True)
class SplatBuffers:
    """What is drawn of Gaussians, and what comes back.

    Attributes:
        splats: projected.
        records: packed for the blend.
        sums: gradient sums.
    """

    splats: dict[str, Tensor]
    records: Tensor
    sums: Tensor

    @classmethod
    def make(cls, n: int, device: torch.device) -> SplatBuffers:
        """Allocate for n Gaussians.

        Raises:
            CudaMemoryError: no room.
        """
        kernels, rows = load(), max(n, 1)
        shapes = {"means2d": (n, 2), "depths": (n,), "conics": (n, 3), "opacities": (n,)}
        splats = {name: empty("the splats", LOWER, shape, device) for name, shape in shapes.items()}
        splats["radii"] = empty("the splats", LOWER, (n, 2), device, torch.int32)
        records = empty("packed splats", LOWER, (rows, kernels.RECORD), device)
        return cls(splats, records, torch.zeros((rows, kernels.RECORD), device=device))

    def struct(self) -> Any:
        """Return the kernels' view; splats are packed for blending as they are projected."""
        return fill(splat_struct(**self.splats, colors=None), records=self.records)


@dataclass(frozen=True)
class RowBuffers:
    """Gaussians between two densification steps, and what a step makes of each.

    Attributes:
        params, m, v: raw parameters and Adam's moments.
        statistics: what density control reads.
        drawn: their splats.
        pop_sides: where each stands in the POP term.
        pop_sums: sums of the POP term's two sides and of the regularizers, for each block of the kernel.
    """

    params: Rows
    m: Rows
    v: Rows
    statistics: KernelStatistics
    drawn: SplatBuffers
    pop_sides: Tensor
    pop_sums: Tensor

    @classmethod
    def make(cls, params: Rows, m: Rows, v: Rows, statistics: KernelStatistics) -> RowBuffers:
        """Allocate what belongs to the rows but for the statistics."""
        kernels, n, device = load(), len(params["means"]), params["means"].device
        return cls(
            dict(params),
            dict(m),
            dict(v),
            statistics,
            SplatBuffers.make(n, device),
            torch.zeros(max(n, 1), dtype=torch.uint8, device=device),
            torch.zeros((max(kernels.important_blocks(n), 1), 3), device=device),
        )

    def __len__(self) -> int:
        return len(self.params["means"])


@dataclass(frozen=True)
class FrameBuffers:
    """Buffers of one image size for the present number of Gaussians.

    Attributes:
        size: width and height, px.
        lists: splats by tile.
        image: the render.
        render_stats: of a phase that tells dominant Gaussians, by the blend's names.
        work: what else blend and loss hand on.
    """

    size: Size
    lists: TileBuffers
    image: Tensor
    render_stats: dict[str, Tensor]
    work: dict[str, Tensor]

    @classmethod
    def make(cls, shared: Shared, n: int, size: Size, capacity: int) -> FrameBuffers:
        """Allocate for n Gaussians and a capacity of instances.

        Raises:
            CudaMemoryError: no room.
        """
        kernels, device, s = load(), shared.device, shared.settings
        tile, exact = list_tile(shared.render(size, 0), counted=False)
        lists = TileBuffers(n, *size, tile, exact, device, s.backward == "gaussian_parallel" and exact)
        lists.reserve(capacity)
        shape = (size[1], size[0])
        maps = ("dominant_ids", *(("n_blended", "n_traversed") if s.counts else ()))
        render_stats = {name: empty("the image", "the image size", shape, device, torch.int32) for name in maps}
        render_stats["dominant_weights"] = empty("the image", "the image size", shape, device)
        render_stats["dominant_counts"] = torch.zeros(max(n, 1), dtype=torch.int32, device=device)
        work = {
            "T_final": empty("the image", "the image size", shape, device),
            "last": empty("the image", "the image size", shape, device, torch.int32),
            "windows": empty("the loss", "the image size", (9, *shape), device),
            "partials": torch.empty((kernels.loss_blocks(*size), 3), device=device),
            "v_image": empty("the image", "the image size", (*shape, 3), device),
        }
        if s.deterministic:
            rows = (lists.capacity * lists.parts, kernels.RECORD)
            work["rows"] = empty("gradient slots", LOWER + ", or use deterministic=False", rows, device)
        if lists.buckets:
            work["checkpoints"] = empty("checkpoints", LOWER, (lists.max_buckets, 4, kernels.TILE_PIXELS), device)
        return cls(size, lists, empty("the image", "the image size", (*shape, 3), device), render_stats, work)
