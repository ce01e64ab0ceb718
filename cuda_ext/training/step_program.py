"""One kind of training step, planned once and launched many times: what every kernel is handed, and their order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from cuda_ext import load
from cuda_ext.arrays import SideStream, fill, pointer, stream_of
from cuda_ext.render.lists import Size, count_instances
from cuda_ext.training.step_buffers import MARGIN, FrameBuffers, RowBuffers, Rows, Shared, SplatBuffers
from pop_ref.settings import PARAMETERS

if TYPE_CHECKING:
    from pop_fast.train.steps import Phase, StepSettings


class DrawProgram:
    """What lists, draws, compares with a photograph and goes back to sums of every splat, for one image size and phase.

    Everything that a launch needs is made here, and held for as long as the program is: its tensors' addresses go into
    the kernels, and into a graph that is captured of `launch`.

    Args:
        shared: what all steps share.
        drawn: the splats, projected and packed by the caller.
        frame: buffers of the image size.
        phase: what the steps do.
    """

    def __init__(self, shared: Shared, drawn: SplatBuffers, frame: FrameBuffers, phase: Phase) -> None:
        self._shared, self._drawn, self._frame = shared, drawn, frame
        self._profile, self._splats = shared.render(frame.size, phase.sh_degree).kernel_profile(), drawn.struct()
        self._photographs, self._objective = shared.views.photographs(), _objective(phase)
        self._loss = _loss(shared, frame)
        self._forward, self._backward = _blends(shared, drawn, frame, phase)
        # where nothing is replayed, single kernels are told apart by time, so that no two run at once
        self.side = SideStream(shared.device, used=shared.settings.replay)
        self.counts: Tensor | None = frame.render_stats["dominant_counts"] if phase.dominance else None

    def launch(self) -> None:
        """Ask the device's current stream for the view that `begin_step` has picked."""
        kernels, shared, splats, profile = load(), self._shared, self._splats, self._profile
        lists, stream = self._frame.lists.struct, stream_of(shared.device)
        state = pointer("state", shared.state, "int32")
        count_instances(lists, splats, profile, state, shared.device, self.side)
        kernels.make_tile_lists(lists, splats, profile, pointer("dominant_counts", self.counts, "int32"), state, stream)
        kernels.blend_forward(lists, self._forward, profile, stream)
        kernels.photometric(self._photographs, self._loss, self._objective, state, stream)
        if not shared.settings.deterministic:
            kernels.clear(pointer("sums", self._drawn.sums), self._drawn.sums.nbytes, stream)
        kernels.blend_backward(lists, self._backward, profile, state, stream)


class StepProgram:
    """The steps of one phase and one image size, for the present rows; see `DrawProgram`.

    Args:
        shared: what all steps share.
        rows: the Gaussians.
        frame: buffers of the image size.
        phase: what the steps do.
    """

    def __init__(self, shared: Shared, rows: RowBuffers, frame: FrameBuffers, phase: Phase) -> None:
        self._shared, self._rows, self._draw = shared, rows, DrawProgram(shared, rows.drawn, frame, phase)
        self._project = shared.render(frame.size, phase.sh_degree).project_settings()
        self._view, self._splats = view_of(shared, frame.size), rows.drawn.struct()
        self._schedule, self._gaussians = schedule(shared), gaussians(rows)
        regularized = any(regularizers(shared.settings, phase, len(rows)).values())
        self._term = pop_term(shared, rows, self._draw.counts, phase) if phase.pop or regularized else None
        self._update = update(shared, rows, self._draw.counts, phase)
        self._record = _record(shared, rows, phase, self._term)

    def launch(self) -> None:
        """Ask the device's current stream for one step."""
        kernels, shared, splats, view = load(), self._shared, self._splats, self._view
        state, stream = pointer("state", shared.state, "int32"), stream_of(shared.device)
        kernels.begin_step(self._schedule, pointer("constants", shared.constants), state, stream)
        kernels.project(self._gaussians, view, self._project, splats, state, stream)
        self._draw.launch()
        if self._term is not None:
            kernels.count_important(self._term, state, stream)
        # what a step notes is known before the update, and read by no one in it
        with self._draw.side.beside():
            kernels.end_step(self._record, state, stream_of(shared.device))
        kernels.update(self._update, view, self._project, splats, state, stream)
        self._draw.side.join()


def view_of(shared: Shared, size: Size) -> Any:
    """Return the kernels' form of the camera that `begin_step` picks, for an image size."""
    return fill(load().View(), viewmat=shared.viewmat, K=shared.K, width=size[0], height=size[1])


def schedule(shared: Shared, n_views: int = 1) -> Any:
    """Return what `begin_step` reads, of steps of so many views."""
    s, views = shared.settings, shared.views
    made = fill(load().Schedule(), views=shared.order, viewmats=views.viewmats, Ks=views.Ks, n_views=n_views)
    fill(made, viewmat=shared.viewmat, K=shared.K, rates=shared.rates, numbers=shared.numbers, eps=s.eps)
    made.beta1, made.beta2 = s.updates.betas
    return made


def gaussians(rows: RowBuffers) -> Any:
    """Return the kernels' form of raw parameters."""
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


def _blends(shared: Shared, drawn: SplatBuffers, frame: FrameBuffers, phase: Phase) -> tuple[Any, Any]:
    kernels, deterministic = load(), shared.settings.deterministic
    passed = {key: frame.work.get(key) for key in ("T_final", "last", "checkpoints")}
    both = {"channels": 3, "records": drawn.records, "background": shared.background, "image": frame.image, **passed}
    forward = fill(kernels.BlendForward(), **both)
    if phase.dominance:
        fill(forward, **frame.render_stats, masks=shared.views.masks, state=shared.state)
    backward = fill(kernels.BlendBackward(), **both, absolute=False, v_image=frame.work["v_image"])
    fill(backward, v_T_final=None, rows=frame.work.get("rows"), sums=drawn.sums)
    backward.set_backward(frame.lists.buckets, not deterministic)
    return forward, backward


def regularizers(settings: StepSettings, phase: Phase, n: int) -> dict[str, float]:
    """Return the weights of a Gaussian's own terms, by the kernels' names: those of the loss over their number.

    Args:
        settings: of the run.
        phase: what the steps do.
        n: Gaussians altogether, those of other processes too.
    """
    entropy = settings.lambda_entropy if phase.entropy else 0.0
    own = {"entropy": entropy, "opacity": settings.opacity_reg, "scale": settings.scale_reg / 3.0}
    return {name: weight / max(n, 1) for name, weight in own.items()}


def pop_term(shared: Shared, rows: RowBuffers, counts: Tensor | None, phase: Phase) -> Any:
    """Return the POP term and the regularizers of the kernels.

    Args:
        shared: what all steps share.
        rows: the Gaussians.
        counts: pixels that each dominates in this view; read where the POP term is on. [n]
        phase: what the steps do.
    """
    s = shared.settings
    before: Tensor | None = rows.statistics.dominant_sum if s.pop_views == "window" else None
    shown: Tensor | None = rows.drawn.splats["radii"] if s.pop_over == "visible" else None
    made = fill(load().PopTerm(), n=len(rows), dominant_counts=counts if phase.pop else None, window_counts=before)
    fill(made, radii=shown, logits=rows.params["opacities"], log_scales=rows.params["scales"])
    return fill(made, sides=rows.pop_sides, sums=rows.pop_sums, **regularizers(s, phase, len(rows)))


def update(
    shared: Shared,
    rows: RowBuffers,
    counts: Tensor | None,
    phase: Phase,
    gradients: Rows | None = None,
    n: int | None = None,
) -> Any:
    """Return what the kernels' update takes.

    Args:
        shared: what all steps share.
        rows: the Gaussians.
        counts: pixels that each dominates in this view, where the phase tells. [n]
        phase: what the steps do.
        gradients: where those of several views are added up, by parameter; None where a step has one view.
        n: Gaussians altogether, where these are one process's share of them.
    """
    s, found = shared.settings, rows.statistics
    made = fill(load().UpdateArrays(), n=len(rows), n_rest=rows.params["shN"].shape[1], sums=rows.drawn.sums)
    fill(made, constants=shared.constants, dominant_counts=counts, pop_sides=rows.pop_sides)
    fill(made, sh_rest_sum=found.sh_rest_sum)
    made.lambda_pop = s.lambda_pop if phase.pop else 0.0
    fill(made, **regularizers(s, phase, len(rows) if n is None else n))
    made.blur_own_view = s.blur_window == "own_view"
    if phase.statistics:
        fill(made, grad_sum=found.grad_sum, n_visible=found.n_visible)
    if phase.blur:
        fill(made, blurred=found.blurred, blur_pixels=shared.blur_pixels)
    if phase.blur or phase.window:
        fill(made, dominant_sum=found.dominant_sum)
    groups = (rows.params, rows.m, rows.v, *(() if gradients is None else (gradients,)))
    for k, name in enumerate(PARAMETERS):
        made.set_group(k, *(pointer(name, group[name]) for group in groups))
    return made


def _record(shared: Shared, rows: RowBuffers, phase: Phase, term: Any) -> Any:
    sums = None if term is None else rows.pop_sums
    made = fill(load().StepRecord(), values=shared.values, history=shared.history, pop_sums=sums)
    return fill(made, n=len(rows), lambda_pop=shared.settings.lambda_pop if phase.pop else 0.0)
