"""The fused training step: photographs resident as bytes, one CUDA graph a step, no host synchronisation in the loop.

`FusedTrainer.run(until)` replays begin -> project -> list -> blend -> loss -> blend back -> update -> end. The device
holds the step counter, picks the view and makes the learning rates, so that one graph serves all steps of a kind. When
instances do not fit, the device raises a flag and leaves parameters and counter alone from that step on; the host sees
the flag two steps late, grows the buffers and goes on from the device's counter: nothing is truncated or lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import BAD_ROW, N_INSTANCES, NOT_BAD, OVERFLOW, STEP, Settings, empty, fill, new_state, stream_of
from cuda_ext.lists import LOWER, WARP_TILE, TileBuffers, splat_struct
from cuda_ext.resident import ResidentViews
from cuda_ext.train_settings import GROUPS, Phase, Statistics, StepSettings

GROWTH = 1.5
FIRST_GUESS = (8, 1024)  # instances a Gaussian, and at least
LATE = 2  # steps between an overflow and its notice


@dataclass
class _Frame:
    """Buffers of one image size for the present number of Gaussians."""

    lists: TileBuffers
    image: Tensor
    told: dict[str, Tensor]
    work: dict[str, Tensor] = field(default_factory=dict)


class FusedTrainer:
    """Owns the device's side of training between two density events.

    Args:
        params: raw float32 CUDA tensors by gsplat's keys; updated in place.
        m, v: Adam's moments, likewise.
        views: the resident photographs and cameras.
        order: the view of every step, at least `settings.max_steps` long.
        settings: objective and update.
        step: the step to begin at.
    """

    def __init__(
        self,
        params: Mapping[str, Tensor],
        m: Mapping[str, Tensor],
        v: Mapping[str, Tensor],
        views: ResidentViews,
        order: Sequence[int],
        settings: StepSettings,
        step: int = 0,
    ) -> None:
        self.settings, self.views = settings, views
        self.device = params["means"].device
        self._order_on_host = list(order)
        self._order = torch.tensor(self._order_on_host, dtype=torch.int32, device=self.device)
        self.state = new_state(self.device)
        self.state[STEP] = step
        self._viewmat, self._K = torch.zeros(16, device=self.device), torch.zeros(9, device=self.device)
        self._constants = torch.zeros(load().STEP_CONSTANTS_FLOATS, device=self.device)
        self.values = torch.zeros(3, device=self.device)
        self._capacity = 0
        self.grown = 0
        self.rebind(params, m, v)

    def rebind(self, params: Mapping[str, Tensor], m: Mapping[str, Tensor], v: Mapping[str, Tensor]) -> None:
        """Take new rows after a density event: buffers, statistics and graphs start anew."""
        self.params, self.m, self.v = dict(params), dict(m), dict(v)
        n = self.n = len(params["means"])
        self.statistics = Statistics.zeros(n, self.device)
        self._splat = {
            "means2d": torch.empty((n, 2), device=self.device),
            "depths": torch.empty(n, device=self.device),
            "conics": torch.empty((n, 3), device=self.device),
            "opacities": torch.empty(n, device=self.device),
            "radii": torch.empty((n, 2), dtype=torch.int32, device=self.device),
            "colors": torch.empty((n, 3), device=self.device),
        }
        self._records = empty("packed splats", LOWER, (max(n, 1), load().RECORD), self.device)
        self._sums = torch.zeros((max(n, 1), load().RECORD), device=self.device)
        self._frames: dict[tuple[int, int], _Frame] = {}
        self._graphs: dict[tuple[int, int, Phase], torch.cuda.CUDAGraph] = {}

    def run(self, until: int, phase: Phase) -> None:
        """Take steps until the counter stands at `until`, all of one phase.

        Raises:
            ValueError: a Gaussian is no longer finite; the message names its row and step.
            CudaMemoryError: no room to grow.
        """
        step = int(self.state[STEP])
        watched: deque[tuple[torch.cuda.Event, Tensor]] = deque()
        while step < until or watched:
            if step < until:
                self._replay(self.views.sizes[self._order_on_host[step]], phase)
                watched.append(self._watch())
                step += 1
                if len(watched) <= LATE and step < until:
                    continue
            event, told = watched.popleft()
            event.synchronize()
            if told[BAD_ROW] != NOT_BAD or told[OVERFLOW] > 0:
                watched.clear()
                step = self._recover()

    def _watch(self) -> tuple[torch.cuda.Event, Tensor]:
        told = torch.empty(self.state.shape, dtype=torch.int32, pin_memory=True)
        told.copy_(self.state, non_blocking=True)
        event = torch.cuda.Event()
        event.record()
        return event, told

    def _recover(self) -> int:
        """Handle what halted the device, and return the step to go on from."""
        told = self.state.tolist()
        if told[BAD_ROW] != NOT_BAD:
            raise ValueError(f"step {told[STEP]}: Gaussian {told[BAD_ROW]} projects to a value that is not finite")
        self.grown += 1
        self._capacity = int(max(told[OVERFLOW], told[N_INSTANCES]) * GROWTH)
        self.state[OVERFLOW] = 0
        self._frames.clear()
        self._graphs.clear()
        return int(told[STEP])

    def _replay(self, size: tuple[int, int], phase: Phase) -> None:
        key = (*size, phase)
        if key in self._graphs:
            self._graphs[key].replay()
            return
        # the first step of a kind runs as it is, which loads the kernels; capturing then executes nothing
        frame = self._frame(size)
        self._launch(frame, size, phase)
        torch.cuda.synchronize(self.device)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._launch(frame, size, phase)
        self._graphs[key] = graph

    def _frame(self, size: tuple[int, int]) -> _Frame:
        if size in self._frames:
            return self._frames[size]
        kernels, (width, height), device = load(), size, self.device
        # a guess that the flag corrects
        per_gaussian, least = FIRST_GUESS
        self._capacity = max(self._capacity, per_gaussian * self.n, least)
        buckets = self.settings.family == "splats"
        lists = TileBuffers(self.n, width, height, WARP_TILE, True, device, buckets)
        lists.reserve(self._capacity)
        shape = (height, width)
        told = {name: torch.empty(shape, dtype=torch.int32, device=device) for name in ("dominant_ids", "n_blended")}
        told["n_traversed"] = torch.empty(shape, dtype=torch.int32, device=device)
        told["dominant_weights"] = torch.empty(shape, device=device)
        told["dominant_counts"] = torch.zeros(max(self.n, 1), dtype=torch.int32, device=device)
        blocks = kernels.loss_blocks(width, height)
        work = {
            "T_final": torch.empty(shape, device=device),
            "last": torch.empty(shape, dtype=torch.int32, device=device),
            "windows": empty("the loss", "the image size", (9, *shape), device),
            "partials": torch.empty((blocks, 2), device=device),
            "v_image": torch.empty((*shape, 3), device=device),
        }
        if self.settings.deterministic:
            work["rows"] = empty("gradient slots", LOWER, (lists.capacity, kernels.RECORD), device)
        if buckets:
            work["checkpoints"] = empty("checkpoints", LOWER, (lists.max_buckets, 4, kernels.TILE_PIXELS), device)
        frame = _Frame(lists, empty("the image", "the image size", (*shape, 3), device), told, work)
        self._frames[size] = frame
        return frame

    def _launch(self, frame: _Frame, size: tuple[int, int], phase: Phase) -> None:
        kernels, s, state, stream = load(), self.settings, self.state.data_ptr(), stream_of(self.device)
        render = Settings(*size, s.profile, WARP_TILE[0], phase.sh_degree, s.antialiased, family=s.family)
        profile, project, lists = render.kernel_profile(), render.project_settings(), frame.lists.struct
        tells = phase.pop or phase.statistics
        splats = splat_struct(**self._splat)
        view = fill(kernels.View(), viewmat=self._viewmat, K=self._K, width=size[0], height=size[1])
        kernels.begin_step(self._schedule(), self._constants.data_ptr(), state, stream)
        kernels.project(self._gaussians(), view, project, splats, state, stream)
        kernels.count_instances(lists, splats, profile, state, stream)
        kernels.make_tile_lists(lists, splats, profile, state, stream)
        kernels.pack_records(self.n, 3, splats, s.profile.alpha_floor, self._records.data_ptr(), stream)
        if tells:
            frame.told["dominant_counts"].zero_()
        shared = {key: frame.work.get(key) for key in ("T_final", "last", "checkpoints")}
        drawn = {"channels": 3, "records": self._records, "background": None, "image": frame.image, **shared}
        told = frame.told if tells else {}
        kernels.blend_forward(lists, fill(kernels.BlendForward(), **drawn, **told), profile, stream)
        kernels.photometric(self.views.photographs(), self._loss(frame, size), self._objective(), state, stream)
        if not s.deterministic:
            self._sums.zero_()
        backward = fill(
            kernels.BlendBackward(),
            **drawn,
            absolute=False,
            v_image=frame.work["v_image"],
            v_T_final=None,
            rows=frame.work.get("rows"),
            sums=self._sums,
        )
        backward.set_family(s.family == "splats", not s.deterministic)
        kernels.blend_backward(lists, backward, profile, state, stream)
        if phase.pop:
            kernels.count_important(self.n, frame.told["dominant_counts"].data_ptr(), state, stream)
        kernels.update(self._update(frame, size, phase), view, project, splats, state, stream)
        kernels.end_step(state, stream)

    def _gaussians(self) -> Any:
        p = self.params
        made = fill(
            load().Gaussians(), n=self.n, raw=True, **{k: p[k] for k in ("means", "quats", "scales", "opacities")}
        )
        fill(made, sh_first=p["sh0"], sh_rest=p["shN"])
        made.sh_first_stride, made.sh_rest_stride = 3, 3 * p["shN"].shape[1]
        return made

    def _schedule(self) -> Any:
        s, views = self.settings, self.views
        made = fill(load().Schedule(), views=self._order, viewmats=views.viewmats, Ks=views.Ks)
        fill(made, viewmat=self._viewmat, K=self._K, means_decay=s.means_decay, max_steps=s.max_steps, eps=s.eps)
        made.beta1, made.beta2 = s.betas
        for k, name in enumerate(GROUPS):
            made.set_lr(k, s.lr[name])
        return made

    def _objective(self) -> Any:
        s = self.settings
        made = fill(load().LossSettings(), pixelwise_weight=1.0 - s.lambda_ssim, ssim_weight=s.lambda_ssim)
        made.margin = 5 if s.padding == "valid" else 0
        made.set_pixelwise(s.l1)
        return made

    def _loss(self, frame: _Frame, size: tuple[int, int]) -> Any:
        work = {name: frame.work[name] for name in ("windows", "partials", "v_image")}
        made = fill(load().LossArrays(), image=frame.image, values=self.values, **work)
        return fill(made, width=size[0], height=size[1])

    def _update(self, frame: _Frame, size: tuple[int, int], phase: Phase) -> Any:
        tells = phase.pop or phase.statistics
        made = fill(load().UpdateArrays(), n=self.n, n_rest=self.params["shN"].shape[1], sums=self._sums)
        fill(made, constants=self._constants, dominant_counts=frame.told["dominant_counts"] if tells else None)
        made.lambda_pop = self.settings.lambda_pop if phase.pop else 0.0
        made.blur_pixels = self.settings.theta_blur * size[0] * size[1]
        fill(made, **(self.statistics.__dict__ if phase.statistics else {}))
        for k, name in enumerate(GROUPS):
            made.set_group(k, *(rows[name].data_ptr() for rows in (self.params, self.m, self.v)))
        return made
