"""One kind of training step, planned once and launched many times: what every kernel is handed, and their order."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import fill, pointer, stream_of
from cuda_ext.render.lists import splat_struct
from cuda_ext.train_settings import Phase
from cuda_ext.training.resident import MARGIN
from cuda_ext.training.step_buffers import FrameBuffers, RowBuffers, Shared
from pop_ref.settings import PARAMETERS


class StepProgram:
    """The steps of one phase and one image size, for the present rows.

    Everything that a launch needs is made here, and held for as long as the program is: its tensors' addresses go into
    the kernels, and into a graph that is captured of `launch`.

    Args:
        shared: what all steps share.
        rows: the Gaussians.
        frame: buffers of the image size.
        phase: what the steps do.
    """

    def __init__(self, shared: Shared, rows: RowBuffers, frame: FrameBuffers, phase: Phase) -> None:
        self._shared, self._rows, self._frame, self._phase = shared, rows, frame, phase
        kernels, (width, height) = load(), frame.size
        render = shared.render(frame.size, phase.sh_degree)
        self._profile, self._project = render.kernel_profile(), render.project_settings()
        # packed for blending as they are projected: nothing else reads their colours
        self._splats = fill(splat_struct(**rows.splats, colors=None), records=rows.records)
        self._view = fill(kernels.View(), viewmat=shared.viewmat, K=shared.K, width=width, height=height)
        self._schedule, self._gaussians = _schedule(shared), _gaussians(rows)
        self._photographs, self._objective = shared.views.photographs(), _objective(phase)
        self._loss = _loss(shared, frame)
        self._forward, self._backward = _blends(shared, rows, frame, phase)
        self._term = _pop_term(shared, rows, frame, phase) if phase.pop else None
        self._update, self._record = _update(shared, rows, frame, phase), _record(shared, rows, phase)

    def launch(self) -> None:
        """Ask the device's current stream for one step."""
        kernels, shared, rows = load(), self._shared, self._rows
        state, stream = pointer("state", shared.state, "int32"), stream_of(shared.device)
        lists, splats, view, profile = self._frame.lists.struct, self._splats, self._view, self._profile
        kernels.begin_step(self._schedule, pointer("constants", shared.constants), state, stream)
        kernels.project(self._gaussians, view, self._project, splats, state, stream)
        kernels.count_instances(lists, splats, profile, state, stream)
        counts = self._frame.render_stats["dominant_counts"] if self._phase.dominance else None
        kernels.make_tile_lists(lists, splats, profile, pointer("dominant_counts", counts, "int32"), state, stream)
        kernels.blend_forward(lists, self._forward, profile, stream)
        kernels.photometric(self._photographs, self._loss, self._objective, state, stream)
        if not shared.settings.deterministic:
            kernels.clear(pointer("sums", rows.sums), rows.sums.nbytes, stream)
        kernels.blend_backward(lists, self._backward, profile, state, stream)
        if self._term is not None:
            kernels.count_important(self._term, state, stream)
        kernels.update(self._update, view, self._project, splats, state, stream)
        kernels.end_step(self._record, state, stream)


def _schedule(shared: Shared) -> Any:
    s, views = shared.settings, shared.views
    made = fill(load().Schedule(), views=shared.order, viewmats=views.viewmats, Ks=views.Ks)
    fill(made, viewmat=shared.viewmat, K=shared.K, rates=shared.rates, numbers=shared.numbers, eps=s.eps)
    made.beta1, made.beta2 = s.betas
    return made


def _gaussians(rows: RowBuffers) -> Any:
    p = rows.params
    own = {k: p[k] for k in ("means", "quats", "scales", "opacities")}
    made = fill(load().Gaussians(), n=len(rows), raw=True, **own, sh_first=p["sh0"], sh_rest=p["shN"])
    made.sh_first_stride, made.sh_rest_stride = 3, 3 * p["shN"].shape[1]
    return made


def _objective(phase: Phase) -> Any:
    goal = phase.objective
    pixel_weight, ssim_weight = goal.weights
    made = fill(load().LossSettings(), pixelwise_weight=pixel_weight, ssim_weight=ssim_weight)
    made.margin = MARGIN if goal.padding == "valid" else 0
    made.set_pixelwise(goal.pixelwise == "l1")
    return made


def _loss(shared: Shared, frame: FrameBuffers) -> Any:
    work = {name: frame.work[name] for name in ("windows", "partials", "v_image")}
    made = fill(load().LossArrays(), image=frame.image, values=shared.values, **work)
    return fill(made, width=frame.size[0], height=frame.size[1])


def _blends(shared: Shared, rows: RowBuffers, frame: FrameBuffers, phase: Phase) -> tuple[Any, Any]:
    kernels, deterministic = load(), shared.settings.deterministic
    passed = {key: frame.work.get(key) for key in ("T_final", "last", "checkpoints")}
    drawn = {"channels": 3, "records": rows.records, "background": shared.background, "image": frame.image, **passed}
    forward = fill(kernels.BlendForward(), **drawn)
    if phase.dominance:
        fill(forward, **frame.render_stats, masks=shared.views.masks, state=shared.state)
    backward = fill(kernels.BlendBackward(), **drawn, absolute=False, v_image=frame.work["v_image"])
    fill(backward, v_T_final=None, rows=frame.work.get("rows"), sums=rows.sums)
    backward.set_backward(frame.lists.buckets, not deterministic)
    return forward, backward


def _pop_term(shared: Shared, rows: RowBuffers, frame: FrameBuffers, phase: Phase) -> Any:
    s = shared.settings
    before: Tensor | None = rows.statistics.dominant_sum if s.pop_views == "window" else None
    shown: Tensor | None = rows.splats["radii"] if s.pop_over == "visible" else None
    made = fill(
        load().PopTerm(), n=len(rows), dominant_counts=frame.render_stats["dominant_counts"], window_counts=before
    )
    return fill(made, radii=shown, logits=rows.params["opacities"], sides=rows.pop_sides, sums=rows.pop_sums)


def _update(shared: Shared, rows: RowBuffers, frame: FrameBuffers, phase: Phase) -> Any:
    s, found = shared.settings, rows.statistics
    made = fill(load().UpdateArrays(), n=len(rows), n_rest=rows.params["shN"].shape[1], sums=rows.sums)
    counts = frame.render_stats["dominant_counts"] if phase.dominance else None
    fill(made, constants=shared.constants, dominant_counts=counts, pop_sides=rows.pop_sides)
    fill(made, sh_rest_sum=found.sh_rest_sum)
    made.lambda_pop = s.lambda_pop if phase.pop else 0.0
    made.blur_own_view = s.blur_window == "own_view"
    if phase.statistics:
        fill(made, grad_sum=found.grad_sum, n_visible=found.n_visible)
    if phase.blur:
        fill(made, blurred=found.blurred, blur_pixels=shared.blur_pixels)
    if phase.blur or phase.window:
        fill(made, dominant_sum=found.dominant_sum)
    for k, name in enumerate(PARAMETERS):
        made.set_group(k, *(pointer(name, group[name]) for group in (rows.params, rows.m, rows.v)))
    return made


def _record(shared: Shared, rows: RowBuffers, phase: Phase) -> Any:
    sums = rows.pop_sums if phase.pop else None
    made = fill(load().StepRecord(), values=shared.values, history=shared.history, pop_sums=sums)
    return fill(made, n=len(rows), lambda_pop=shared.settings.lambda_pop)
