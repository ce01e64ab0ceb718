"""The fused training step: photographs resident as bytes, one CUDA graph a step, no host synchronisation in the loop.

`FusedTrainer.run(until)` replays begin -> project -> list -> blend -> loss -> blend back -> update -> end. The device
holds the step counter, picks the view, makes the learning rates and keeps what every step tells, so that one graph
serves all steps of a kind. When instances do not fit, the device raises a flag and does nothing from that step on; the
host sees the flag two steps late, grows the buffers and goes on from the device's counter: nothing is cut or lost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import (
    BAD_ROW,
    N_INSTANCES,
    NOT_BAD,
    OVERFLOW,
    STEP,
    Settings,
    empty,
    fill,
    new_state,
    pointer,
    stream_of,
)
from cuda_ext.graphs import Watch, captured
from cuda_ext.lists import LOWER, TileBuffers, list_tile, splat_struct
from cuda_ext.resident import MARGIN, ResidentViews
from cuda_ext.train_settings import GROUPS, Phase, Statistics, StepSettings, StepValues

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

    Attributes:
        statistics: what density control reads; zeros after `rebind`.
        values: what the last step told, in the order of `StepValues`.
        grown: how often the instance buffers had to grow.
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
        self.settings, self.views, self.step = settings, views, step
        self.device = params["means"].device
        self._order_on_host = list(order)
        self._order = torch.tensor(self._order_on_host, dtype=torch.int32, device=self.device)
        self.state = new_state(self.device)
        self.state[STEP] = step
        self._viewmat, self._K = torch.zeros(16, device=self.device), torch.zeros(9, device=self.device)
        self._constants = torch.zeros(load().STEP_CONSTANTS_FLOATS, device=self.device)
        self._background = torch.tensor(settings.background, device=self.device) if any(settings.background) else None
        self.values = torch.zeros(load().N_VALUES, device=self.device)
        self._history = torch.zeros((settings.max_steps, load().N_VALUES), device=self.device)
        self._watch = Watch(self.state, LATE + 1)
        self._capacity = 0
        self.grown = 0
        self.rebind(params, m, v)

    def rebind(self, params: Mapping[str, Tensor], m: Mapping[str, Tensor], v: Mapping[str, Tensor]) -> None:
        """Take new rows after a density event: buffers, statistics and graphs start anew."""
        self.params, self.m, self.v = dict(params), dict(m), dict(v)
        n = self.n = len(params["means"])
        # what the old number of Gaussians needed goes first, so that old and new need not fit side by side
        self._frames: dict[tuple[int, int], _Frame] = {}
        self._steps: dict[tuple[int, int, Phase], Callable[[], None]] = {}
        self.statistics = Statistics.zeros(n, self.device)
        shapes = {"means2d": (n, 2), "depths": (n,), "conics": (n, 3), "opacities": (n,), "colors": (n, 3)}
        self._splat = {name: empty("the splats", LOWER, shape, self.device) for name, shape in shapes.items()}
        self._splat["radii"] = empty("the splats", LOWER, (n, 2), self.device, torch.int32)
        self._records = empty("packed splats", LOWER, (max(n, 1), load().RECORD), self.device)
        self._sums = torch.zeros((max(n, 1), load().RECORD), device=self.device)
        self._pop_sums = torch.zeros((max(load().important_blocks(n), 1), 2), device=self.device)

    def run(self, until: int, phase: Phase) -> None:
        """Take steps until the counter stands at `until`, all of one phase.

        Raises:
            ValueError: a Gaussian is no longer finite; the message names its row and step.
            CudaMemoryError: no room to grow.
        """
        watch = self._watch
        while self.step < until or watch:
            if self.step < until:
                self._take(self.views.sizes[self._order_on_host[self.step]], phase)
                watch.post()
                self.step += 1
                if len(watch) <= LATE and self.step < until:
                    continue
            told = watch.take()
            if told[BAD_ROW] != NOT_BAD or told[OVERFLOW] > 0:
                self.step = self._recover()
                watch.clear()

    def told(self, first: int, last: int) -> list[StepValues]:
        """Return what the steps from `first` to before `last` told; `run` must have taken them in this session."""
        return [StepValues(*row) for row in self._history[first:last].tolist()]

    @property
    def n_instances(self) -> int:
        """How many list entries the last step had."""
        return int(self.state[N_INSTANCES])

    @property
    def radii(self) -> Tensor:
        """Extents of the last step's splats, px, 0 where culled. [N, 2] int32"""
        return self._splat["radii"]

    def told_maps(self) -> dict[tuple[int, int], dict[str, Tensor]]:
        """Return, by image size, what the last step of a phase that tells dominant Gaussians told of every pixel.

        How many splats it blended and visited is among it where `settings.counts` asked for that.
        """
        return {size: frame.told for size, frame in self._frames.items()}

    def _recover(self) -> int:
        """Handle what halted the device, and return the step to go on from."""
        flags = self.state.tolist()
        if flags[BAD_ROW] != NOT_BAD:
            self.step = flags[STEP]
            raise ValueError(f"step {flags[STEP]}: Gaussian {flags[BAD_ROW]} has a value that is not finite")
        self.grown += 1
        self._capacity = int(max(flags[OVERFLOW], flags[N_INSTANCES]) * GROWTH)
        self.state[OVERFLOW] = 0
        self._frames.clear()
        self._steps.clear()
        return int(flags[STEP])

    def _take(self, size: tuple[int, int], phase: Phase) -> None:
        key = (*size, phase)
        if key in self._steps:
            self._steps[key]()
            return
        frame = self._frame(size)

        def launch() -> None:
            self._launch(frame, size, phase)

        # the first step of a kind runs as it is, which loads the kernels; capturing then executes nothing
        launch()
        if self.settings.replay:
            torch.cuda.synchronize(self.device)
            self._steps[key] = captured(launch, self.device)

    def _frame(self, size: tuple[int, int]) -> _Frame:
        if size in self._frames:
            return self._frames[size]
        kernels, (width, height), device, s = load(), size, self.device, self.settings
        # a guess that the flag corrects
        per_gaussian, least = FIRST_GUESS
        self._capacity = max(self._capacity, per_gaussian * self.n, least)
        tile, exact = list_tile(self._render(size, 0), counted=False)
        lists = TileBuffers(self.n, width, height, tile, exact, device, s.family == "splats" and exact)
        lists.reserve(self._capacity)
        shape = (height, width)
        maps = ("dominant_ids", *(("n_blended", "n_traversed") if s.counts else ()))
        told = {name: empty("the image", "the image size", shape, device, torch.int32) for name in maps}
        told["dominant_weights"] = empty("the image", "the image size", shape, device)
        told["dominant_counts"] = torch.zeros(max(self.n, 1), dtype=torch.int32, device=device)
        work = {
            "T_final": empty("the image", "the image size", shape, device),
            "last": empty("the image", "the image size", shape, device, torch.int32),
            "windows": empty("the loss", "the image size", (9, *shape), device),
            "partials": torch.empty((kernels.loss_blocks(width, height), 3), device=device),
            "v_image": empty("the image", "the image size", (*shape, 3), device),
        }
        if s.deterministic:
            rows = (lists.capacity * lists.parts, kernels.RECORD)
            work["rows"] = empty("gradient slots", LOWER + ", or use deterministic=False", rows, device)
        if lists.buckets:
            work["checkpoints"] = empty("checkpoints", LOWER, (lists.max_buckets, 4, kernels.TILE_PIXELS), device)
        frame = _Frame(lists, empty("the image", "the image size", (*shape, 3), device), told, work)
        self._frames[size] = frame
        return frame

    def _render(self, size: tuple[int, int], sh_degree: int) -> Settings:
        s = self.settings
        return Settings(*size, s.profile, s.profile.tile_size, sh_degree, s.antialiased, family=s.family)

    def _launch(self, frame: _Frame, size: tuple[int, int], phase: Phase) -> None:
        kernels, s, state, stream = load(), self.settings, self.state.data_ptr(), stream_of(self.device)
        render = self._render(size, phase.sh_degree)
        profile, project, lists = render.kernel_profile(), render.project_settings(), frame.lists.struct
        splats = splat_struct(**self._splat)
        view = fill(kernels.View(), viewmat=self._viewmat, K=self._K, width=size[0], height=size[1])
        kernels.begin_step(self._schedule(), self._constants.data_ptr(), state, stream)
        kernels.project(self._gaussians(), view, project, splats, state, stream)
        kernels.count_instances(lists, splats, profile, state, stream)
        kernels.make_tile_lists(lists, splats, profile, state, stream)
        kernels.pack_records(self.n, 3, splats, s.profile.alpha_floor, self._records.data_ptr(), stream)
        shared = {key: frame.work.get(key) for key in ("T_final", "last", "checkpoints")}
        drawn = {"channels": 3, "records": self._records, "background": self._background, "image": frame.image}
        forward = fill(kernels.BlendForward(), **drawn, **shared)
        if phase.tells:
            self._clear(frame.told["dominant_counts"])
            fill(forward, **frame.told, masks=self.views.masks, state=self.state)
        kernels.blend_forward(lists, forward, profile, stream)
        objective = self._objective(phase)
        kernels.photometric(self.views.photographs(), self._loss(frame, size), objective, state, stream)
        if not s.deterministic:
            self._clear(self._sums)
        backward = fill(kernels.BlendBackward(), **drawn, **shared, absolute=False, v_image=frame.work["v_image"])
        fill(backward, v_T_final=None, rows=frame.work.get("rows"), sums=self._sums)
        backward.set_family(frame.lists.buckets, not s.deterministic)
        kernels.blend_backward(lists, backward, profile, state, stream)
        if phase.pop:
            counts, logits = frame.told["dominant_counts"], self.params["opacities"]
            sums = self._pop_sums.data_ptr()
            kernels.count_important(self.n, counts.data_ptr(), logits.data_ptr(), sums, state, stream)
        kernels.update(self._update(frame, size, phase), view, project, splats, state, stream)
        kernels.end_step(self._record(phase), state, stream)

    def _clear(self, tensor: Tensor) -> None:
        load().clear(tensor.data_ptr(), tensor.nbytes, stream_of(self.device))

    def _gaussians(self) -> Any:
        p = self.params
        rows = {k: p[k] for k in ("means", "quats", "scales", "opacities")}
        made = fill(load().Gaussians(), n=self.n, raw=True, **rows, sh_first=p["sh0"], sh_rest=p["shN"])
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

    def _objective(self, phase: Phase) -> Any:
        s, weight = self.settings, phase.lambda_ssim
        made = fill(load().LossSettings(), pixelwise_weight=(1.0 - weight) * s.pixelwise_scale)
        made.ssim_weight = weight * (0.5 if s.d_ssim_halved else 1.0)
        made.margin = MARGIN if s.padding == "valid" else 0
        made.set_pixelwise(phase.l1)
        return made

    def _loss(self, frame: _Frame, size: tuple[int, int]) -> Any:
        work = {name: frame.work[name] for name in ("windows", "partials", "v_image")}
        made = fill(load().LossArrays(), image=frame.image, values=self.values, **work)
        return fill(made, width=size[0], height=size[1])

    def _update(self, frame: _Frame, size: tuple[int, int], phase: Phase) -> Any:
        made = fill(load().UpdateArrays(), n=self.n, n_rest=self.params["shN"].shape[1], sums=self._sums)
        counts = frame.told["dominant_counts"] if phase.tells else None
        fill(made, constants=self._constants, dominant_counts=counts)
        made.lambda_pop = self.settings.lambda_pop if phase.pop else 0.0
        made.blur_pixels = self.settings.blur_pixels(*size)
        found = self.statistics
        if phase.statistics:
            fill(made, grad_sum=found.grad_sum, n_visible=found.n_visible)
        if phase.blur:
            fill(made, dominant_sum=found.dominant_sum, blurred=found.blurred)
        for k, name in enumerate(GROUPS):
            made.set_group(k, *(pointer(name, rows[name]) for rows in (self.params, self.m, self.v)))
        return made

    def _record(self, phase: Phase) -> Any:
        sums = self._pop_sums if phase.pop else None
        made = fill(load().StepRecord(), values=self.values, history=self._history, pop_sums=sums)
        return fill(made, n=self.n, lambda_pop=self.settings.lambda_pop)
