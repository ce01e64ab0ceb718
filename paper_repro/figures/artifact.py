"""Figure 3: a 3DGS render when every opacity is pushed to 1, and what the gradients of the losses see of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from paper_repro.figures.data import Asked
from paper_repro.figures.foot import foot_of
from paper_repro.figures.opacity_one import STEPS, WEIGHT, Pushed, pushed
from paper_repro.figures.sheet import Drawn, Sheet, show
from paper_repro.figures.style import GREY, INK, SMALL, TEXT

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GAP, _TITLE, _BAR, _EDGE = 0.12, 0.17, 0.24, 0.04
_HIGHEST: Final = 1.7
# of the values of a map, what its brightest colour stands for
_TOP: Final = 0.99


@dataclass(frozen=True)
class Panel:
    """One map of the figure.

    Attributes:
        letter: its place.
        key: its name in the table.
        title: as written.
        values: mean over the channels. [H, W]
        unit: of the values.
        correlation: with the error map over the pixels; None where a map is constant, or is that map.
    """

    letter: str
    key: str
    title: str
    values: np.ndarray
    unit: str
    correlation: float | None


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
