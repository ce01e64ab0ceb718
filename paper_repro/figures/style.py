"""How every figure looks: fonts, widths, one colour a method that can be told apart without colour vision, labels.

A figure is made for a column of 3.3 inches and has its final size, so that a point in it is a point in print. Colours
are those of Okabe and Ito; curves are named where they end and not in a legend.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from paper_repro.rows import ROWS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis

# widths of a column and of a page's text, inches
COLUMN: Final = 3.3
TEXT: Final = 6.9
INK: Final = "#222222"
GREY: Final = "#8a8a8a"
# of notes, points
SMALL: Final = 5.6
_SIZE: Final = 7.0
# of the PNG
SAVED_DPI: Final = 300

_BLACK, _ORANGE, _SKY, _GREEN = "#404040", "#E69F00", "#56B4E9", "#009E73"
_BLUE, _VERMILION, _PURPLE = "#0072B2", "#D55E00", "#CC79A7"
# a method keeps its colour in every figure
_METHODS: Final = {
    "pop": ("POP", _VERMILION),
    "3dgs": ("3DGS", _BLACK),
    "3dgs_2023": ("3DGS of 2023", GREY),
    "gsplat": ("gsplat", _BLUE),
    "pup": ("PUP-3DGS", _PURPLE),
    "pup_star": ("PUP-3DGS*", _PURPLE),
    "mini_splatting": ("Mini-Splatting", _GREEN),
    "mini_splatting_star": ("Mini-Splatting*", _GREEN),
    "taming": ("Taming-3DGS", _SKY),
    "speedy_splat": ("Speedy-Splat", _ORANGE),
    "l1_div_1": ("L1 + SSIM", _VERMILION),
    "l2_without_ssim": ("L2", _GREEN),
    "l2": ("L2 + SSIM", _BLUE),
    **{f"l1_div_{n}": (f"L1 / {n}", _VERMILION) for n in (2, 5, 10, 20, 50, 100)},
}
# as in the paper: L1 red, L2 green, SSIM orange
LOSSES: Final = {"grad_l1": _VERMILION, "grad_l2": _GREEN, "grad_ssim": _ORANGE}


def look() -> AbstractContextManager[None]:
    """Return the context in which figures are made and saved."""
    from matplotlib import rc_context

    return rc_context(
        {
            "font.family": "DejaVu Sans",
            "font.size": _SIZE,
            "mathtext.fontset": "dejavusans",
            "axes.labelsize": _SIZE,
            "axes.titlesize": _SIZE,
            "axes.titlelocation": "left",
            "axes.titlepad": 3.0,
            "axes.labelpad": 2.5,
            "axes.linewidth": 0.6,
            "axes.edgecolor": INK,
            "axes.labelcolor": INK,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "axes.axisbelow": True,
            "text.color": INK,
            "xtick.color": INK,
            "ytick.color": INK,
            "xtick.labelsize": 6.4,
            "ytick.labelsize": 6.4,
            "xtick.major.size": 2.4,
            "ytick.major.size": 2.4,
            "xtick.minor.size": 1.4,
            "ytick.minor.size": 1.4,
            "xtick.major.width": 0.6,
            "ytick.major.width": 0.6,
            "xtick.minor.width": 0.4,
            "ytick.minor.width": 0.4,
            "xtick.major.pad": 2.0,
            "ytick.major.pad": 2.0,
            "grid.linewidth": 0.4,
            "grid.color": "#e4e4e4",
            "lines.linewidth": 1.1,
            "lines.solid_capstyle": "round",
            "lines.solid_joinstyle": "round",
            # letters as outlines: the same on every machine, and the same bytes for the same numbers
            "svg.fonttype": "path",
            "svg.hashsalt": "paper_repro",
            "savefig.dpi": SAVED_DPI,
        }
    )


def name_of(row: str) -> str:
    """Return what a figure calls a row."""
    return _METHODS[row][0] if row in _METHODS else row


def color_of(row: str) -> str:
    """Return a row's colour; rows without one of their own are grey."""
    assert row in ROWS, row
    return _METHODS[row][1] if row in _METHODS else GREY


def count(n: float, digits: int = 3) -> str:
    """Write a number of Gaussians or steps: 850, 67k, 2.5M."""
    for unit, letter in ((1e6, "M"), (1e3, "k")):
        if n >= unit:
            return f"{n / unit:.{digits}g}{letter}"
    return f"{n:.0f}"


def step_ticks(axis: Axis) -> None:
    """Mark steps at round numbers, in thousands."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], integer=True))
    axis.set_major_formatter(FuncFormatter(lambda step, _: count(step)))


def log_ticks(axis: Axis, low: float, high: float) -> None:
    """Mark a logarithmic axis at a few round numbers: 1, 2, 5 of each decade where that is few enough.

    Args:
        axis: to mark.
        low: where it begins.
        high: where it ends.
    """
    from matplotlib.ticker import FixedFormatter, FixedLocator, MaxNLocator, NullFormatter

    marks: list[float] = []
    for steps in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0), (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)):
        decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        found = [float(f"{m * 10.0**d:.6g}") for d in decades for m in steps if low <= m * 10.0**d <= high]
        if len(found) <= 6:
            marks = found
        if len(found) >= 4:
            break
    if len(marks) < 3:
        marks = [float(x) for x in MaxNLocator(4).tick_values(low, high) if low <= x <= high]
    minor = [m * 10.0**d for d in range(-12, 12) for m in range(1, 10) if low <= m * 10.0**d <= high]
    axis.set_major_locator(FixedLocator(marks))
    axis.set_minor_locator(FixedLocator(minor if high > 3.0 * low else []))
    axis.set_major_formatter(FixedFormatter(_apart(marks)))
    axis.set_minor_formatter(NullFormatter())


def _apart(marks: Sequence[float]) -> list[str]:
    """Write numbers with as few digits as tell them apart."""
    for digits in range(3, 12):
        labels = [count(x, digits) if x >= 1000.0 else f"{x:.{digits}g}" for x in marks]
        if len(set(labels)) == len(labels):
            return labels
    return [repr(x) for x in marks]


@dataclass(frozen=True)
class End:
    """The name of a curve, and where that ends."""

    x: float
    y: float
    text: str
    color: str


def label_ends(axes: Axes, ends: Sequence[End]) -> None:
    """Write names to the right of the axes, at the heights of the curves' ends, moved apart where they would touch.

    A thin line leads from a curve to its name where the name is not beside its end.

    Args:
        axes: whose limits and place are settled.
        ends: the curves.
    """
    points = 72.0 / axes.figure.dpi
    left, top = (float(v) for v in axes.transAxes.transform((1.0, 1.0)) * points)
    order = sorted(ends, key=lambda end: end.y)
    at = [[float(v) for v in axes.transData.transform((end.x, end.y)) * points] for end in order]
    heights = spread([y for _, y in at], _SIZE * 1.1, top)
    where = {"xycoords": "figure points", "annotation_clip": False}
    for end, (x, y), height in zip(order, at, heights, strict=True):
        beside = abs(y - height) < 1.0 and left - x < 8.0
        start = left + (3.0 if beside else 10.0)
        axes.annotate(end.text, (start, height), color=darker(end.color), va="center_baseline", **where)
        if not beside:
            line = {"arrowstyle": "-", "color": GREY, "lw": 0.5, "ls": (0, (1, 1.5)), "shrinkA": 0.0, "shrinkB": 0.0}
            axes.annotate(
                "", (x + 1.5, y), xytext=(start - 1.5, height), textcoords="figure points", arrowprops=line, **where
            )


def spread(wanted: Sequence[float], spacing: float, top: float) -> list[float]:
    """Move heights apart to at least a spacing, as little as that takes, and not over the top.

    Args:
        wanted: rising heights.
        spacing: least distance of two.
        top: highest that is allowed, if there is room.
    """
    # neighbours that touch become a group around the mean of what its members want
    groups: list[list[float]] = []
    for height in wanted:
        groups.append([height])
        while len(groups) > 1 and _low(groups[-1], spacing) - _high(groups[-2], spacing) < spacing:
            last = groups.pop()
            groups[-1].extend(last)
    placed = [_low(group, spacing) + i * spacing for group in groups for i in range(len(group))]
    # what is too high pushes the rest down
    for i in reversed(range(len(placed))):
        placed[i] = min(placed[i], top - (len(placed) - 1 - i) * spacing)
    return placed


def _low(group: Sequence[float], spacing: float) -> float:
    return sum(group) / len(group) - spacing * (len(group) - 1) / 2.0


def _high(group: Sequence[float], spacing: float) -> float:
    return sum(group) / len(group) + spacing * (len(group) - 1) / 2.0


def darker(color: str) -> str:
    """Return a colour that can be read as text on white: at most so light."""
    from matplotlib.colors import to_hex, to_rgb

    red, green, blue = to_rgb(color)
    factor = min(1.0, 0.42 / (0.2126 * red + 0.7152 * green + 0.0722 * blue))
    return to_hex((red * factor, green * factor, blue * factor))
