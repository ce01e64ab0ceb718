"""The tensors behind a fused training step: of the whole training, of the present rows, of one image size.

Photographs and cameras stay on the GPU, as bytes, with masks and the blurred values that SSIM needs every time.
Photographs for which there is no room pass through one place: each is copied there before a step that compares with it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import STEP, VIEW, Settings, empty, fill, new_state, stream_of
from cuda_ext.render.lists import LOWER, Size, TileBuffers, list_tile, splat_struct

if TYPE_CHECKING:
    from pop_fast.train.steps import StepSettings

Rows = Mapping[str, Tensor]
MARGIN = 5  # px, half of SSIM's window
FEWER = "the photographs' size or number"


@dataclass
class KernelStatistics:
    """What the kernels collect, one entry a Gaussian, until new rows come.

    `sh_rest_sum` is Adam's, of the same life: gradients that wait for their update; None where none do. [N, n_rest, 3]
    """

    grad_sum: Tensor
    n_visible: Tensor
    dominant_sum: Tensor
    blurred: Tensor
    sh_rest_sum: Tensor | None = None

    @classmethod
    def zeros(cls, n: int, device: torch.device, n_rest: int | None = None) -> KernelStatistics:
        """Start from nothing; `n_rest` bands' gradients wait, None for none."""
        visible, dominant = (torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2))
        flags = torch.zeros(n, dtype=torch.uint8, device=device)
        waiting = None if n_rest is None else torch.zeros((n, n_rest, 3), device=device)
        return cls(torch.zeros(n, device=device), visible, dominant, flags, waiting)

    def rows(self, own: slice) -> KernelStatistics:
        """Return some rows, in the same memory."""
        waiting = None if self.sh_rest_sum is None else self.sh_rest_sum[own]
        return KernelStatistics(
            self.grad_sum[own], self.n_visible[own], self.dominant_sum[own], self.blurred[own], waiting
        )


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


class ResidentViews:
    """The training views, of which as many photographs as have room stay on the device.

    Args:
        images: uint8 [H, W, 3] each, on any device.
        viewmats: world -> camera. [V, 4, 4]
        Ks: intrinsics, px. [V, 3, 3]
        masks: bool [H, W] each, True keeps, or None; one list entry a view, or None for no masks at all.
        padding: SSIM's border, "valid" or "same".
        device: the GPU.
        cache_moments: keep the photographs' blurred values, 24 bytes a pixel, where all photographs stay.
        room: bytes that photographs and masks may take, None for what they need. The place that the others pass
            through is part of it, and is there also where the room is smaller.

    Attributes:
        bytes: what photographs and masks take.
        n_passing: how many photographs do not stay.
        copied: how many were copied since, each for a step.

    Raises:
        ValueError: a photograph is not uint8 [H, W, 3], a mask has another size, or "valid" has no window.
        CudaMemoryError: no room.
    """

    def __init__(
        self,
        images: Sequence[Tensor],
        viewmats: Tensor,
        Ks: Tensor,
        masks: Sequence[Tensor | None] | None,
        padding: str,
        device: torch.device,
        cache_moments: bool = True,
        room: int | None = None,
    ) -> None:
        self.device, self._margin, self.copied = device, MARGIN if padding == "valid" else 0, 0
        kept = [None] * len(images) if masks is None else list(masks)
        for k, (image, mask) in enumerate(zip(images, kept, strict=True)):
            self._check(k, image, mask)
        self.sizes = [(image.shape[1], image.shape[0]) for image in images]
        self.kept_pixels = [_kept(size, mask) for size, mask in zip(self.sizes, kept, strict=True)]
        self.viewmats = viewmats.to(device, torch.float32).contiguous()
        self.Ks = Ks.to(device, torch.float32).contiguous()
        planes = {"images": list(images)}
        if any(mask is not None for mask in kept):
            whole = [torch.ones(1, 1, dtype=torch.bool).expand(image.shape[:2]) for image in images]
            planes["masks"] = [w if mask is None else mask for mask, w in zip(kept, whole, strict=True)]
        self._place(planes, room)
        shares = [self._share(size, mask) for size, mask in zip(self.sizes, kept, strict=True)]
        self._shares = torch.tensor(shares, dtype=torch.float32, device=device)
        if cache_moments and not self.n_passing:
            what, lower = "the photographs' blurred values", f"{FEWER}, or use cache_moments=False"
            self._moments = [empty(what, lower, (6, h, w), device) for w, h in self.sizes]
            self._tables["moments"] = self._table(self._moments)
            self._fill_moments()

    def fetch(self, view: int) -> None:
        """Have a photograph on the device when what is asked of its current stream from now on runs.

        The host waits where it must be copied, since photographs lie in pageable memory.
        """
        if view in self._passing and view != self._there:
            for there, pixels in zip(self._passage, self._passing[view], strict=True):
                there[: pixels.numel()].copy_(pixels.reshape(-1))
            self._there = view
            self.copied += 1

    def facts(self) -> dict[str, int]:
        """Return the bytes of photographs and masks on the device, and how many photographs pass."""
        return {"photograph_bytes": self.bytes, "photographs_passing": self.n_passing}

    @property
    def masks(self) -> Tensor | None:
        """Return the table of masks by view, or None where there are none."""
        return self._tables.get("masks")

    def photographs(self) -> Any:
        """Return the kernels' view of the tables."""
        tables = {name: self._tables.get(name) for name in ("images", "masks", "moments")}
        return fill(load().Photographs(), shares=self._shares, **tables)

    def _check(self, k: int, image: Tensor, mask: Tensor | None) -> None:
        if image.dtype != torch.uint8 or image.dim() != 3 or image.shape[2] != 3:
            raise ValueError(f"images[{k}] is {image.dtype} {list(image.shape)}; it must be uint8 [H, W, 3]")
        if min(image.shape[:2]) <= 2 * self._margin:
            raise ValueError(f"images[{k}] is {list(image.shape[:2])} px; SSIM with padding 'valid' needs 11 x 11")
        if mask is not None and mask.shape != image.shape[:2]:
            raise ValueError(f"masks[{k}] is {list(mask.shape)}; it must be {list(image.shape[:2])} as images[{k}]")

    def _place(self, planes: Mapping[str, Sequence[Tensor]], room: int | None) -> None:
        """Copy what stays, and make the place for what passes: its pointers stand in the tables from now on."""
        needs = [sum(plane.numel() for plane in of_view) for of_view in zip(*planes.values(), strict=True)]
        stays = _how_many_stay(needs, room)
        self.n_passing, self._there = len(needs) - stays, None
        self._passing = {k: [planes[name][k] for name in planes] for k in range(stays, len(needs))}
        self._passage = []
        self._tables, self._kept = {}, []
        for name, of_views in planes.items():
            what = f"the {'photographs' if name == 'images' else name}", FEWER
            dtype, most = of_views[0].dtype, max((plane.numel() for plane in of_views[stays:]), default=0)
            kept = [empty(*what, tuple(plane.shape), self.device, dtype).copy_(plane) for plane in of_views[:stays]]
            passage = empty(*what, (most,), self.device, dtype)
            self._passage.append(passage)
            self._kept += kept
            self._tables[name] = self._table([*kept, *[passage] * self.n_passing])
        self.bytes = sum(tensor.numel() for tensor in (*self._kept, *self._passage))

    def _share(self, size: tuple[int, int], mask: Tensor | None) -> tuple[float, float]:
        m, (width, height) = self._margin, size
        pixels = _kept(size, mask)
        inner = _kept((width - 2 * m, height - 2 * m), None if mask is None else mask[m : height - m, m : width - m])
        return 1.0 / max(3 * pixels, 1), 1.0 / (3 * inner) if inner else 0.0

    def _table(self, tensors: Sequence[Tensor]) -> Tensor:
        return torch.tensor([tensor.data_ptr() for tensor in tensors], dtype=torch.int64, device=self.device)

    def _fill_moments(self) -> None:
        # kernels run on the current device, which need not be the photographs'
        with torch.cuda.device_of(self.viewmats):
            self._launch_moments()

    def _launch_moments(self) -> None:
        kernels, state = load(), new_state(self.device)
        settings = fill(kernels.LossSettings(), margin=self._margin)
        for k, (width, height) in enumerate(self.sizes):
            state[VIEW] = k
            # the render plays no part in the photograph's blurred values; any image of that size will do
            blank = torch.zeros((height, width, 3), device=self.device)
            loss = fill(kernels.LossArrays(), image=blank, width=width, height=height)
            kernels.target_moments(self.photographs(), loss, settings, state.data_ptr(), stream_of(self.device))


def _how_many_stay(needs: Sequence[int], room: int | None) -> int:
    """Return how many photographs, from the first on, fit together with the place for the largest of the others."""
    if room is None or sum(needs) <= room:
        return len(needs)
    most, before = max(needs), itertools.accumulate(needs)
    return next(k for k, taken in enumerate(before) if taken + most > room)


def _kept(size: tuple[int, int], mask: Tensor | None) -> int:
    return size[0] * size[1] if mask is None else int(mask.count_nonzero())
