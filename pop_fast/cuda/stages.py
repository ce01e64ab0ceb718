"""What this program asks of the kernels of `cuda_ext`: the stages of a view, a pass over it, whole training steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from cuda_ext.arrays import Settings, new_state
from cuda_ext.render.autograd import Blend, Project, RenderStats
from cuda_ext.render.lists import WARP_TILE, list_tile, make_lists, splat_struct
from cuda_ext.render.scores import ScoredView
from cuda_ext.training.batch_step import BatchTrainer
from cuda_ext.training.step_buffers import ResidentViews
from cuda_ext.training.train_step import FusedTrainer
from pop_fast.stages.compositing import Composite
from pop_fast.stages.contributions import Contributions, DominantPoints, fisher_blocks, points_on_rays, towards_camera
from pop_fast.stages.projection import intrinsics
from pop_fast.stages.splatting import ProjectionSettings, Shapes, Splats, colors_of
from pop_fast.stages.stage_set import PassInput, Seen
from pop_fast.stages.tiles import TileLists
from pop_fast.stages.types import Camera, Gaussians
from pop_fast.train.engines import translate_oom
from pop_fast.train.stepper import Fused, MakeFused, Rows, Task
from pop_fast.train.steps import StepSettings
from pop_fast.train.views import ViewTensors

WIDEST = 4  # channels that one launch blends


@dataclass(frozen=True)
class SplatsOnGpu(Splats):
    """Splats, and the flags that the kernels have raised while they were made."""

    state: Tensor | None = None  # int32, on the device


@dataclass(frozen=True)
class CudaStages:
    """Draws views as `pop_fast.api.backend.ViewStages` says.

    Optimizations: exact tile lists, two narrow stable sorts, one warp a 16 x 8 tile, moment-form gradients.
    """

    # backward, deterministic: as `pop_fast.api.backends.CudaBackend` says
    backward: str  # as `pop_fast.api.backends.CudaBackend` says
    deterministic: bool

    def covariances(self, quats: Tensor, scales: Tensor) -> Shapes:
        """Return both as they are: one kernel makes covariances and projects them."""
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
        """Project Gaussians, and shade them where harmonics are given."""
        own = self._settings(settings, settings.profile.tile_size, sh_degree)
        with _on_device_of(means):
            state = new_state(means.device)
            sh = None if sh_degree is None else colors
            made = Project.apply(means, *shapes, opacities, sh, viewmat, settings.K, own, state)
        means2d, depths, conics, blended, radii, shaded = made
        return SplatsOnGpu(
            means2d, depths, conics, blended, radii, colors=colors if sh is None else shaded, state=state
        )

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
        """List rows by tile and blend them, so many channels at a time as the kernels are made for.

        Raises:
            NotImplementedError: absolute gradients with more channels than one launch blends.
        """
        assert isinstance(seen, SplatsOnGpu)
        assert seen.state is not None
        colors, channels = colors_of(rows), colors_of(rows).shape[1]
        if channels > WIDEST and absgrad_sink is not None:
            raise NotImplementedError(
                f"absgrad with more than {WIDEST} channels: absolute sums of pieces do not add up"
            )
        own = self._settings(settings, tile_size, absgrad=absgrad_sink is not None)
        pieces: list[Tensor] = []
        left: list[Tensor] = []
        with _on_device_of(rows.means2d):
            tile, exact = list_tile(own, counts)
            lists = make_lists(own, _struct(rows), len(rows.depths), rows.depths.device, tile, exact, seen.state)
            stats = _empty_stats(rows, settings) if dominance or counts else None
            for first in range(0, channels, WIDEST):
                piece = slice(first, min(first + WIDEST, channels))
                own_colors, behind = _padded(colors[:, piece]), None if background is None else background[piece]
                behind = None if behind is None else _padded(behind[None])[0]
                inputs = (rows.means2d, rows.conics, rows.opacities, own_colors, behind)
                # every piece leaves the same light; the first one carries its gradient
                found = Blend.apply(*inputs, lists, own, seen.state, stats if first == 0 else None, absgrad_sink)
                pieces.append(found[0][..., : piece.stop - first])
                left.append(found[1])
        image = pieces[0] if len(pieces) == 1 else torch.cat(pieces, -1)
        if stats is None:
            return Composite(image, 1.0 - left[0], None, None, None, None, None)
        ids = stats.dominant_ids.long()
        return Composite(image, 1.0 - left[0], ids, stats.dominant_weights, stats.n_blended, stats.n_traversed, None)

    def tile_lists(self, rows: Splats, settings: ProjectionSettings, tile_size: int) -> TileLists:
        own, size = self._settings(settings, tile_size), (tile_size, tile_size)
        with _on_device_of(rows.means2d):
            found = make_lists(own, _struct(rows), len(rows.depths), rows.depths.device, size, False)
            listed, begin, end = (found.tensor(name) for name in ("listed", "tile_begin", "tile_end"))
        lengths = (end - begin).long()
        offsets = torch.cat((lengths.new_zeros(1), lengths.cumsum(0)))
        across, down = -(-settings.width // tile_size), -(-settings.height // tile_size)
        return TileLists(listed.long(), offsets, tile_size, across, down)

    def counts_entries(self, tile_size: int) -> bool:
        """Visited entries are counted with tiles made of the warps' own."""
        return tile_size % WARP_TILE[0] == 0

    def _settings(
        self, of: ProjectionSettings, tile_size: int, sh_degree: int | None = None, absgrad: bool = False
    ) -> Settings:
        return Settings(
            *(of.width, of.height, of.profile, tile_size, sh_degree, of.antialiased, of.radius_clip, absgrad),
            *(self.backward, self.deterministic),
        )


@contextmanager
def _on_device_of(tensor: Tensor) -> Iterator[None]:
    # kernels run on the current device, which need not be the tensors'
    with torch.cuda.device_of(tensor):
        yield


def _padded(colors: Tensor) -> Tensor:
    """Return colours of a width that the kernels are made for: 1, 3 or 4 channels."""
    return torch.cat((colors, colors.new_zeros(len(colors), 1)), 1) if colors.shape[1] == 2 else colors


def _struct(rows: Splats) -> object:
    means2d, depths, conics, opacities = (
        t.detach().contiguous() for t in (rows.means2d, rows.depths, rows.conics, rows.opacities)
    )
    return splat_struct(means2d, depths, conics, opacities, rows.radii.contiguous(), None)


def _empty_stats(rows: Splats, settings: ProjectionSettings) -> RenderStats:
    shape, device = (settings.height, settings.width), rows.depths.device
    ids, blended, traversed = (torch.empty(shape, dtype=torch.int32, device=device) for _ in range(3))
    counts = torch.zeros(max(len(rows.depths), 1), dtype=torch.int32, device=device)
    return RenderStats(ids, torch.empty(shape, device=device), blended, traversed, counts)


class CudaView:
    """A shot that has been drawn on the GPU where its Gaussians lie.

    Raises:
        PopError: the GPU has no room; says what to lower.
    """

    def __init__(self, pass_input: PassInput) -> None:
        self._input = pass_input
        g, c = pass_input.gaussians, pass_input.camera
        rows = (g.means, g.quats, g.scales, g.opacities, g.sh)
        with translate_oom():
            how = (pass_input.sh_degree, pass_input.background, pass_input.profile, pass_input.antialiased)
            self._view = ScoredView(rows, c.viewmat, c.K, c.width, c.height, *how)

    def seen(self) -> Seen:
        view = self._view
        return Seen(view.image, view.dominant_ids.long(), view.radii, view.depths)

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        with translate_oom():
            found = self._view.contributions(None if pixel_map is None else pixel_map.float())
        weight_sum, n_pixels, map_sum, distance_sum = found.T
        return Contributions(weight_sum, n_pixels.to(torch.int64), map_sum, distance_sum)

    def sensitivities(self) -> Tensor:
        with translate_oom():
            return self._view.sensitivities()

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.contributions.fisher_blocks`, of its own screen moments; made on the CPU, in float64."""
        with translate_oom():
            moments = self._view.screen_moments()
        pass_input = self._input
        g, c = pass_input.gaussians, pass_input.camera
        gaussians = Gaussians(*(t.cpu() for t in (g.means, g.quats, g.scales, g.opacities, g.sh)))
        camera = Camera(c.viewmat.cpu(), c.K.cpu(), c.width, c.height)
        blocks = fisher_blocks(gaussians, camera, moments.cpu(), pass_input.sh_degree, pass_input.profile)
        return blocks.to(moments.device)

    def dominant_points(self) -> DominantPoints:
        pass_input = self._input
        c = pass_input.camera
        rays = intrinsics(c.K, c.width, c.height, pass_input.profile)
        ids = self._view.dominant_of(towards_camera(pass_input.gaussians, c).float(), rays)
        points = points_on_rays(ids, pass_input.gaussians, c, pass_input.profile)
        return DominantPoints(points.float(), ids, self._view.T_final)


# of the card's free memory, what photographs may take, and their blurred values; the rest is for Gaussians and lists
PHOTOGRAPHS_SHARE = 0.25
MOMENTS_SHARE = 0.25
_BYTES_OF_MOMENTS = 24  # a pixel


def make_fused(task: Task) -> MakeFused:
    """Return what makes the fused step, with the photographs on the GPU."""
    return partial(_fused, task)


def _fused(
    task: Task,
    params: Rows,
    m: Rows,
    v: Rows,
    views: Sequence[ViewTensors],
    order: Sequence[int],
    settings: StepSettings,
    step: int,
) -> Fused:
    given = (params, m, v, _resident(views, settings, params["means"].device), order, settings, step)
    size = task.config.batch_size
    return FusedTrainer(*given) if size == 1 else BatchTrainer(*given, size, task.ranks)


def _resident(views: Sequence[ViewTensors], settings: StepSettings, device: torch.device) -> ResidentViews:
    pixels = sum(view.height * view.width for view in views)
    free, _ = torch.cuda.mem_get_info(device)
    cameras = (torch.cat([view.viewmat for view in views]), torch.cat([view.K for view in views]))
    given = ([view.photo for view in views], *cameras, [view.mask for view in views], settings.padding, device)
    keeps = _BYTES_OF_MOMENTS * pixels <= MOMENTS_SHARE * free
    return ResidentViews(*given, cache_moments=keeps, room=int(PHOTOGRAPHS_SHARE * free))
