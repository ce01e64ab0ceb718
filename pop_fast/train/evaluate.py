"""Measure held-out views (PSNR, SSIM and, with weights at hand, LPIPS), and keep what the report shows of them.

Also measured is what a splat weighs in every file format, and how well it shows the views when it comes back from one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.data import apply_similarity, to_capture_frame
from pop_fast.errors import PopError
from pop_fast.io.formats import decoded, encoded, format_names
from pop_fast.io.images import error_magnitude, error_picture, id_colors, write_png
from pop_fast.stages.appearance import color_correct
from pop_fast.stages.losses import WINDOW_SIZE, ssim
from pop_fast.train.config import TrainConfig
from pop_fast.train.lpips import LPIPS, VARIANTS
from pop_fast.train.results import ResultFolder
from pop_fast.train.signals import heard
from pop_fast.train.views import Rendered, ViewTensors, evenly, render_view
from pop_ref.constants import PAPER

NO_LPIPS = "no weights were given (lpips_vgg, lpips_alex)"
ALPHA_FLOOR: Final = PAPER.alpha_floor


@dataclass(frozen=True)
class ViewMetrics:
    """What was measured on one view; `lpips` by variant, `cc_psnr` after fitting colours, where that was asked for."""

    psnr: float
    ssim: float
    lpips: Mapping[str, float]
    cc_psnr: float | None = None


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return `-10 log10(mean squared error)` in dB of images in [0, 1], inf when they are equal.

    Args:
        image: clamped to [0, 1], not rounded to 8 bit. [H, W, 3]
        target: [H, W, 3]
        mask: True where a pixel counts; None for all. [H, W]
    """
    squares = (image.clamp(0.0, 1.0) - target) ** 2
    error = float((squares if mask is None else squares[mask]).double().mean())
    return -10.0 * math.log10(error) if error > 0.0 else math.inf


def measure(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    nets: Sequence[LPIPS] = (),
    color_corrected: bool = False,
) -> ViewMetrics:
    """Measure one view, as gsplat does: on floats clamped to [0, 1], SSIM over windows that lie inside.

    Masked pixels are left out of PSNR, and given the photograph's colour for SSIM and LPIPS, whose windows need
    whole images. With `color_corrected`, PSNR is measured again with each channel fitted to the photograph's.
    """
    image = image.clamp(0.0, 1.0)
    whole = image if mask is None else torch.where(mask[..., None], image, target)
    lpips = {variant: net(whole, target, variant) for net in nets for variant in VARIANTS[net.net]}
    corrected = psnr_after_correction(image, target, mask) if color_corrected else None
    return ViewMetrics(psnr(image, target, mask), float(ssim(whole, target, padding="valid")), lpips, corrected)


def psnr_after_correction(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return PSNR after `color_correct` over the pixels that the mask keeps: gsplat's cc_psnr; arguments as `psnr`."""
    kept = torch.ones(image.shape[:2], dtype=torch.bool) if mask is None else mask
    return psnr(color_correct(image.clamp(0.0, 1.0)[kept], target[kept]), target[kept])


def too_small(views: Sequence[ViewTensors]) -> str | None:
    """Say which view is the first that SSIM finds no whole window in, or None."""
    for view in views:
        if min(view.width, view.height) < WINDOW_SIZE:
            return f"{view.name} is {view.width} x {view.height} px, and SSIM needs {WINDOW_SIZE} x {WINDOW_SIZE}"
    return None


def average(views: Sequence[ViewMetrics], nets: Sequence[LPIPS]) -> dict[str, Any]:
    """Average over views; `lpips` is gsplat's variant where AlexNet's weights were given, else 3DGS's, else null."""
    means = {name: _mean([view.lpips[name] for view in views]) for net in nets for name in VARIANTS[net.net]}
    chosen = next((name for name in ("alex_norm", "vgg_01") if name in means), None)
    corrected = [view.cc_psnr for view in views if view.cc_psnr is not None]
    return {
        "psnr": _mean([view.psnr for view in views]),
        **({"cc_psnr": _mean(corrected)} if corrected else {}),
        "ssim": _mean([view.ssim for view in views]),
        "lpips": means[chosen] if chosen else None,
        "lpips_net": chosen,
        "lpips_variants": means,
        "lpips_weights_sha256": {name: value for net in nets for name, value in net.sha256.items()},
        "lpips_reason": None if chosen else NO_LPIPS,
    }


def population(opacities: Tensor) -> dict[str, Any]:
    """Count Gaussians: all, those that can reach a pixel (opacity >= 1/255), and the shares at either pole."""
    n = max(len(opacities), 1)
    return {
        "num_GS": len(opacities),
        "num_GS_above_floor": int((opacities >= ALPHA_FLOOR).sum()),
        "opacity_below_0.1": int((opacities < 0.1).sum()) / n,
        "opacity_above_0.9": int((opacities > 0.9).sum()) / n,
    }


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


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
        config: background, profile and the like; with `exposure` PSNR is also measured after fitting colours.
        folder: where pictures of the first `config.max_renders` views go; None keeps none.

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
        "n_blended": per_pixel[0] / n if views else None,
        "n_traversed": per_pixel[1] / n if views else None,
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
    arrays = {"name": view.name, "render": render, "photo": photo, "dominant_ids": ids.astype(np.int32)}
    folder.write_arrays(f"val_{name}", **arrays, psnr=metrics.psnr, ssim=metrics.ssim)


# held-out views that are rendered for every format, at most; of more, an even selection
_MOST_VIEWS: Final = 4


@torch.no_grad()
def measure_encodings(
    backend: Any,
    params: Mapping[str, Tensor],
    views: Sequence[ViewTensors],
    config: TrainConfig,
    sh_degree: int,
    world_transform: np.ndarray,
) -> Iterator[dict[str, Any]]:
    """Write a splat in every format, in the capture's own frame, read it back and measure it in the training frame.

    A format that cannot hold the splat is left out.

    Args:
        params: raw parameters, in the training frame.
        world_transform: the training frame from the capture's. [4, 4]

    Yields:
        What the statistics hold of a format, as soon as it is measured: its name, bytes, Gaussians, mean PSNR over some
            held-out views after the round trip (dB; None where there is none), and how many these are.
    """
    some = evenly(views, _MOST_VIEWS)
    plain = {name: value.detach().cpu() for name, value in params.items()}
    own = to_capture_frame(plain, world_transform)
    for name in format_names():
        try:
            data = encoded(name, own, config.antialiased)
        except PopError:
            continue
        back = apply_similarity(decoded(name, data)[0], world_transform)
        rendered = [render_view(backend, back, view, config, sh_degree).image for view in some]
        mean = _mean([psnr(image, view.target(), view.mask) for image, view in zip(rendered, some, strict=True)])
        entry = {"format": name, "bytes": len(data), "num_gaussians": len(own["means"])}
        yield {**entry, "psnr": mean, "views": len(some)}
