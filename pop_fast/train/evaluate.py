"""Measure the held-out views, and keep what the report shows of them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pop_fast.io.images import write_png
from pop_fast.io.pictures import error_magnitude, error_picture, id_colors
from pop_fast.train.config import TrainConfig
from pop_fast.train.lpips import LPIPS
from pop_fast.train.metrics import ViewMetrics, average, measure
from pop_fast.train.results import ResultFolder
from pop_fast.train.signals import heard
from pop_fast.train.views import Rendered, ViewTensors, render_view

# mean absolute error that is drawn in the brightest colour
_ERROR_TOP = 0.25


@torch.no_grad()
def evaluate(
    backend: Any,
    params: Mapping[str, Tensor],
    views: Sequence[ViewTensors],
    config: TrainConfig,
    sh_degree: int,
    nets: Sequence[LPIPS] = (),
    folder: ResultFolder | None = None,
    step: int = 0,
) -> dict[str, Any]:
    """Render and measure views.

    Args:
        backend: what renders.
        params: raw parameters.
        views: held-out views.
        config: background, profile and the like; with `exposure` PSNR is also measured after fitting colours.
        sh_degree: highest active colour band.
        nets: LPIPS networks.
        folder: where pictures of the first `config.max_renders` views go; None keeps none.
        step: in the pictures' names.

    Returns:
        Averages over the views; Gaussians per pixel; seconds per rendered view; `per_view` metrics by name.
    """
    measured: list[ViewMetrics] = []
    per_view: dict[str, Any] = {}
    per_pixel = np.zeros(2)
    seconds = 0.0
    for i, view in enumerate(views):
        start = time.perf_counter()
        rendered = render_view(backend, params, view, config, sh_degree, counts=True)
        seconds += time.perf_counter() - start
        per_pixel += gaussians_per_pixel(rendered.info)
        metrics = measure(rendered.image, view.target(), view.mask, nets, color_corrected=config.exposure)
        measured.append(metrics)
        corrected = {} if metrics.cc_psnr is None else {"cc_psnr": metrics.cc_psnr}
        per_view[view.name] = {"psnr": metrics.psnr, **corrected, "ssim": metrics.ssim, **metrics.lpips}
        if folder is not None and i < config.max_renders:
            _keep_pictures(folder, f"step{step}_{i:04d}", view, rendered, metrics)
    n = max(len(views), 1)
    return {
        **average(measured, nets),
        "n_blended": per_pixel[0] / n,
        "n_traversed": per_pixel[1] / n,
        "ellipse_time": seconds / n,
        "views": len(views),
        "per_view": per_view,
    }


def gaussians_per_pixel(info: Mapping[str, Any]) -> tuple[float, float]:
    """Return how many Gaussians a pixel blends, and how many entries of its tile's list it visits, on average."""
    return float(info["n_contrib"].double().mean()), float(info["n_traversed"].double().mean())


def _keep_pictures(
    folder: ResultFolder, name: str, view: ViewTensors, rendered: Rendered, metrics: ViewMetrics
) -> None:
    render = (rendered.image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    photo = view.photo.numpy()
    error = error_picture(error_magnitude(render, photo), _ERROR_TOP)
    ids = rendered.info["dominant_ids"][0].numpy()
    # of a large view, a second or more within OpenCV
    heard(write_png, folder.path / "renders" / f"val_{name}.png", np.concatenate([render, photo, error], axis=1))
    write_png(folder.path / "renders" / f"dominant_{name}.png", id_colors(ids))
    folder.write_arrays(
        f"val_{name}",
        name=view.name,
        render=render,
        photo=photo,
        dominant_ids=ids.astype(np.int32),
        psnr=metrics.psnr,
        ssim=metrics.ssim,
    )
