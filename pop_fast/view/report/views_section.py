"""The report's held-out views: photograph and render under one slider, error and depth beside them."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Final

import numpy as np

from pop_fast.view import pictures
from pop_fast.view.report.model import ReportView

DEPTH_COLORS: Final = "viridis_r"
_NOTHING: Final = (112, 112, 118)


def views_section(views: Sequence[ReportView], n_held_out: int | None) -> str:
    """Show held-out views.

    Args:
        views: the worst first.
        n_held_out: how many were measured, more than have pictures perhaps.
    """
    if not views:
        return ""
    errors = [pictures.error_magnitude(view.render, view.photo) for view in views]
    top = pictures.error_scale(errors)
    near, far = depth_range([view.depth for view in views if view.depth is not None])
    rows = [_view(view, error, top, near, far) for view, error in zip(views, errors, strict=True)]
    some = f" Pictures of {len(views)} of {n_held_out}." if n_held_out is not None and n_held_out > len(views) else ""
    legend = _bar("error", pictures.colorbar_css(), "0", f"{255 * top:.0f} of 255 and more")
    if any(view.depth is not None for view in views):
        legend += _bar(
            "depth", pictures.colorbar_css(DEPTH_COLORS), f"{near:.3g}", f"{far:.3g} units of the capture, logarithmic"
        )
    return (
        "<h2>Held-out views, the worst first</h2><p>Photographs that training never saw: drag the line between "
        "photograph and render. Error is the mean over the channels of |render − photo|; depth is the mean of what a "
        f"pixel blends, grey where nothing is; one scale for all views.{some}</p>"
        f'<div class="bars">{legend}</div><div class="views">{"".join(rows)}</div>'
    )


def depth_range(depths: Sequence[np.ndarray]) -> tuple[float, float]:
    """Choose one range for all depth maps: their joint 1st to 99th percentile, without NaN."""
    known = [depth[np.isfinite(depth)][:: max(1, depth.size // 50_000)] for depth in depths]
    joined = np.concatenate(known) if known else np.zeros(0)
    if not len(joined):
        return 0.1, 1.0
    near, far = (max(float(np.quantile(joined, q)), 1e-12) for q in (0.01, 0.99))
    return near, max(far, near * (1.0 + 1e-6))


def depth_picture(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Colour a depth map by its logarithm, near in yellow and far in violet, grey where it is not finite.

    A garden has its background many times as far away as its table: evenly spaced colours would leave the table one.

    Args:
        depth: over 0, or NaN. [H, W]
        near: yellow, over 0.
        far: violet, over `near`.

    Returns:
        uint8 [H, W, 3]
    """
    known = np.isfinite(depth)
    level = np.log(np.clip(np.where(known, depth, near), near, far) / near) / np.log(far / near)
    picture = pictures.colormap_table(DEPTH_COLORS)[np.round(255.0 * level).astype(np.uint8)]
    picture[~known] = _NOTHING
    return picture


def _view(view: ReportView, error: np.ndarray, top: float, near: float, far: float) -> str:
    name = escape(view.name)
    numbers = [] if view.psnr is None else [f"PSNR {view.psnr:.2f} dB"]
    numbers += [] if view.ssim is None else [f"SSIM {view.ssim:.4f}"]
    head = f"<b>{name}</b>" + "".join(f'<span class="num">{text}</span>' for text in numbers)
    height, width = view.photo.shape[:2]
    beside = [_figure("error", name, pictures.error_picture(error, top))]
    if view.depth is not None:
        beside.append(_figure("depth", name, depth_picture(view.depth, near, far)))
    slider = (
        f'<figure class="slider" style="aspect-ratio:{width}/{height}">'
        f'<img alt="photo of {name}" src="{pictures.data_uri(pictures.fit(view.photo))}">'
        f'<img class="over" alt="render of {name}" src="{pictures.data_uri(pictures.fit(view.render))}">'
        '<span class="left">photograph</span><span class="right">render</span><i></i>'
        f'<input type="range" min="0" max="100" step="0.5" value="50" aria-label="photograph against render, {name}">'
        "</figure>"
    )
    kind = "tall" if height > width else "wide"
    return f'<div class="view"><p>{head}</p><div class="looks {kind}">{slider}{"".join(beside)}</div></div>'


def _figure(what: str, name: str, picture: np.ndarray) -> str:
    uri = pictures.data_uri(pictures.fit(picture))
    return (
        f'<figure><img loading="lazy" alt="{what} of {name}" src="{uri}">'
        f'<figcaption class="caption">{what}</figcaption></figure>'
    )


def _bar(what: str, colors: str, low: str, high: str) -> str:
    return f'<div class="bar"><span>{what}</span>{low}<i style="background:{colors}"></i>{high}</div>'
