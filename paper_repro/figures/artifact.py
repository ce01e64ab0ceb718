"""Figure 3: a 3DGS render when every opacity is pushed to 1, and what the gradients of the losses see of it.

A finished 3DGS model is trained on under its own loss with (1 - o) on all Gaussians. The paper's prior pushes up what
is important and down what is not; the figure shows what there is without that distinction. The Gaussians stay as they
are, and centres move at the rate that the training ended with, so that nothing but the push is new.
"""

from __future__ import annotations

import math
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from paper_repro.collect import file_hash
from paper_repro.figures.data import Asked
from paper_repro.figures.style import GREY, INK, SMALL, TEXT, Drawn, Sheet, foot_of, show
from paper_repro.jobs import Job, job_named
from paper_repro.results import Result
from paper_repro.scenes import MADE, SCENES, find_folder
from paper_repro.train_row import Options, capture_folder, load_capture_of, train_row
from pop_fast.errors import PopError

if TYPE_CHECKING:
    import torch
    from matplotlib.axes import Axes
    from torch import Tensor

    from pop_fast.data import Capture
    from pop_fast.train import TrainConfig

_GAP, _TITLE, _BAR, _EDGE = 0.12, 0.17, 0.24, 0.04
_HIGHEST: Final = 1.7
# of the values of a map, what its brightest colour stands for
_TOP: Final = 0.99
STEPS: Final = 1_000
# of the mean of 1 - o; the paper does not state its own. At 0.1, half of the demo capture's Gaussians stay under 0.1
WEIGHT: Final = 1.0
_ROW: Final = "3dgs"
_FOLDER: Final = "figure_3"


@dataclass(frozen=True)
class Panel:
    """One map of the figure."""

    letter: str  # its place
    key: str  # its name in the table
    title: str  # as written
    values: np.ndarray  # mean over the channels. [H, W]
    unit: str  # of the values
    correlation: float | None  # with the error map over the pixels; None where a map is constant, or is that map


def six_panels(asked: Asked) -> Drawn:
    """Figure 3: photograph, render, error, and the gradients of L1, SSIM and L2."""
    found = pushed(asked)
    maps = panels_of(found)
    opaque = 100.0 * float((found.opacities > 0.9).float().mean())
    mse = float(((found.image.clamp(0.0, 1.0) - found.photo) ** 2).mean())
    note = " ".join(
        [
            f"A 3DGS model after {STEPS:,} further steps under its own loss, L1 and SSIM, with the mean of 1 − o added "
            f"at weight {WEIGHT:g}: {opaque:.0f} % of the opacities are over 0.9. One held-out view, "
            f"{-10.0 * math.log10(mse):.2f} dB. Absolute values, mean over the channels, in units of 1/(3HW) in d to "
            "f; r: correlation with c over the pixels. The steps below are those of the 3DGS model.",
            *foot_of(asked.scale, [found.base]),
        ]
    )
    height, width = found.photo.shape[:2]
    cell = (TEXT - 2.0 * _EDGE - 2.0 * _GAP) / 3.0
    tall = min(cell * height / width, _HIGHEST)
    sheet = Sheet(note, 2.0 * (tall + _TITLE + _BAR) + 0.02, TEXT)
    pictures = [("a", "photograph", found.photo), ("b", "render", found.image.clamp(0.0, 1.0))]
    for place in range(6):
        left = _EDGE + (place % 3) * (cell + _GAP)
        bottom = _BAR + (1 - place // 3) * (tall + _TITLE + _BAR)
        wide = tall * width / height
        axes = sheet.axes(left + (cell - wide) / 2.0, bottom, wide, tall)
        if place < 2:
            letter, title, picture = pictures[place]
            show(axes, picture.numpy())
            _titled(sheet, left, bottom + tall, letter, title)
        else:
            panel = maps[place - 2]
            _mapped(sheet, axes, panel, (left + (cell - wide) / 2.0, bottom, wide))
            _titled(sheet, left, bottom + tall, panel.letter, panel.title)
    return Drawn(sheet.figure, *_table(found, maps, mse))


def panels_of(found: Pushed) -> list[Panel]:
    """Make the error and the three gradients with respect to the image."""
    from pop_fast.stages import losses

    slope = 1.0 / found.image.numel()
    error = (found.image - found.photo).abs().mean(dim=2).numpy()
    gradients = (
        ("d", "grad_l1", "|∂L1/∂C|", losses.l1_vjp(found.image, found.photo, 1.0)),
        ("e", "grad_ssim", "|∂SSIM/∂C|", losses.d_ssim_vjp(found.image, found.photo, 1.0, "same")),
        ("f", "grad_l2", "|∂L2/∂C|", losses.l2_vjp(found.image, found.photo, 1.0)),
    )
    panels = [Panel("c", "error", "|render − photograph|", error, "", None)]
    for letter, key, title, gradient in gradients:
        values = gradient.abs().mean(dim=2).numpy() / slope
        panels.append(Panel(letter, key, title, values, "1/(3HW)", correlation(values, error)))
    return panels


def correlation(one: np.ndarray, other: np.ndarray) -> float | None:
    """Return Pearson's correlation of two maps over their pixels, or None where one is constant."""
    a, b = (x.astype(np.float64) - x.mean(dtype=np.float64) for x in (one, other))
    norms = [float(np.sqrt((x * x).sum())) for x in (a, b)]
    flat = [norm <= 1e-6 * float(np.abs(x).sum()) for norm, x in zip(norms, (one, other), strict=True)]
    return None if any(flat) else float((a * b).sum()) / (norms[0] * norms[1])


def _titled(sheet: Sheet, left: float, top: float, letter: str, title: str) -> None:
    axes = sheet.axes(left, top, 1.0, _TITLE)
    axes.set_axis_off()
    axes.text(0.0, 0.25, f"({letter}) {title}", va="baseline")


def _mapped(sheet: Sheet, axes: Axes, panel: Panel, place: tuple[float, float, float]) -> None:
    """Show a map with its scale below it."""
    left, bottom, width = place
    top = float(np.quantile(panel.values, _TOP)) or 1.0
    show(axes, panel.values, cmap="magma", vmin=0.0, vmax=top)
    bar = sheet.axes(left, bottom - 0.075, width, 0.05)
    show(bar, np.linspace(0.0, 1.0, 256)[None], cmap="magma")
    for x, value, align in ((0.0, "0", "left"), (1.0, f"{top:.2g}", "right")):
        bar.text(x, -0.6, value, transform=bar.transAxes, ha=align, va="top", size=SMALL, color=GREY)
    if panel.letter != "c":
        r = "constant" if panel.correlation is None else f"r = {panel.correlation:.2f}"
        bar.text(0.5, -0.6, r, transform=bar.transAxes, ha="center", va="top", size=SMALL + 0.6, color=INK)


def _table(found: Pushed, maps: list[Panel], mse: float) -> tuple[list[str], list[tuple[Any, ...]]]:
    rows: list[tuple[Any, ...]] = [
        (p.letter, p.key, float(p.values.mean()), float(p.values.max()), "" if p.correlation is None else p.correlation)
        for p in maps
    ]
    rows += [("", "psnr", -10.0 * math.log10(mse), "", "")]
    rows += [("", "share of opacities over 0.9", float((found.opacities > 0.9).double().mean()), "", "")]
    rows += [("", f"run {found.base.run}, view {found.view}", "", "", "")]
    return ["panel", "quantity", "mean", "max", "correlation with the error"], rows


@dataclass(frozen=True)
class OpacityOne:
    """A strategy by gsplat's protocol that leaves the Gaussians alone and pulls every opacity to 1.

    Attributes:
        weight: of the mean of 1 - o in the loss.
    """

    weight: float = WEIGHT

    def check_sanity(self, params: Any, optimizers: Any) -> None:
        """See `pop_fast.density.Strategy`; any parameters will do."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """See `pop_fast.density.Strategy`; nothing is remembered."""
        return {}

    def step_pre_backward(self, params: Any, optimizers: Any, state: Any, step: int, info: Any) -> None:
        """See `pop_fast.density.Strategy`."""

    def step_post_backward(
        self, params: Any, optimizers: Any, state: Any, step: int, info: Any, packed: bool = False
    ) -> None:
        """See `pop_fast.density.Strategy`; the Gaussians stay."""

    def regularizer(self, opacities: Tensor, state: Any, step: int, info: Any) -> Tensor:
        """Return the term that is added to the loss."""
        return self.weight * (1.0 - opacities).mean()


@dataclass(frozen=True)
class Pushed:
    """The trained Gaussians, and one held-out view of them."""

    base: Result  # the 3DGS run that they come from
    image: torch.Tensor  # the render. [H, W, 3]
    photo: torch.Tensor  # the photograph. [H, W, 3]
    view: str  # its name
    opacities: torch.Tensor  # of the Gaussians. [N]


def pushed(asked: Asked) -> Pushed:
    """Train what the figure shows, or continue with it, or take it where it is finished.

    Raises:
        PopError: no scene of the scale is there, or as `train_row`.
    """
    job = _job(asked)
    base, ply = _base(asked, job)
    folder = asked.work / asked.scale / "opacity_one" / f"{job.scene.name}_{job.seed}_{base.run}"
    config = _config(asked, job, folder)
    capture, _ = load_capture_of(job, config)
    final = folder / "ply" / f"point_cloud_{STEPS - 1}.ply"
    if not final.is_file():
        print(f"figure 3: {STEPS:,} steps from the Gaussians of run {base.run}, on the CPU", flush=True)
        _train(config, capture, ply)
        shutil.rmtree(folder / "ckpts", ignore_errors=True)
    return _seen(config, capture, base, final)


def _job(asked: Asked) -> Job:
    """Choose the paper's scene, or the cheapest of the scale that is there."""
    jobs = [job_named(_ROW, scene, asked.scale) for scene in asked.scenes(["kitchen"])]
    for job in sorted(jobs, key=lambda job: job.cost):
        if job.scene.name in MADE:
            return job
        try:
            find_folder(job.scene, asked.data)
        except PopError:
            continue
        return job
    names = ", ".join(job.scene.name for job in jobs)
    raise PopError(
        f"figure 3 at scale {asked.scale} is not drawn: {asked.data} has none of {names}; name another --data"
    )


def _base(asked: Asked, job: Job) -> tuple[Result, Path]:
    """Return the 3DGS run to start from, and its Gaussians; where they were not kept it is trained for the figure."""
    for result in asked.results:
        if (result.row, result.scene, result.seed) == (job.row.name, job.scene.name, job.seed):
            kept = sorted((job.work(asked.work) / "ply").glob("point_cloud_*.ply"))
            # the folder may be that of another run of the row
            if kept and result.ply_hash in (None, file_hash(kept[-1])):
                return result, kept[-1]
    work = asked.work / _FOLDER
    print(f"figure 3: the Gaussians of {job} were not kept (--keep-ply), so they are trained for it", flush=True)
    result = train_row(job, Options(data=asked.data, results=work / "results", work=work, keep_ply=True))
    kept = sorted((job.work(work) / "ply").glob("point_cloud_*.ply"))
    if not kept:
        raise PopError(f"{job.work(work)}: its Gaussians are gone; remove {work} to train them again")
    return result, kept[-1]


def _config(asked: Asked, job: Job, folder: Path) -> TrainConfig:
    from pop_fast.api.backend import get_backend

    whole = job.config()
    ended = whole.lr.means * whole.lr.means_decay
    here = Options(data=asked.data, work=asked.work)
    return job.config(
        data=str(capture_folder(SCENES[job.scene.name], here).absolute()),
        result_dir=str(folder),
        max_steps=STEPS,
        eval_steps=(),
        sh_interval=1,
        threads=1,
        # a strategy of one's own is trained by autograd, on the CPU
        backend="compiled" if get_backend("compiled").available() else "fast",
        **{"lr.means": ended, "lr.means_decay": 1.0},
    )


def _train(config: TrainConfig, capture: Capture, ply: Path) -> None:
    from pop_fast.io.ply import load_ply
    from pop_fast.train import TrainingRun

    TrainingRun(config, capture, resume=True, strategy=OpacityOne(), initial=load_ply(ply)).run()


def _seen(config: TrainConfig, capture: Capture, base: Result, ply: Path) -> Pushed:
    import torch

    from pop_fast.api.backend import get_backend
    from pop_fast.io.ply import load_ply
    from pop_fast.stages.covariance import opacities_from_logits
    from pop_fast.train.views import ViewTensors, render_view

    params = load_ply(ply)
    view = ViewTensors.of(capture.test_views(config.test_every)[0])
    with torch.no_grad():
        rendered = render_view(get_backend(config.backend), params, view, config, config.sh_degree)
    return Pushed(base, rendered.image, view.target(), view.name, opacities_from_logits(params["opacities"]))
