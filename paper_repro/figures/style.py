"""How every figure looks: fonts, widths, colours, labels, its sheet, and what stands below it.

A figure is made for a column of 3.3 inches and has its final size, so that a point in it is a point in print. Colours
are those of Okabe and Ito; curves are named where they end and not in a legend. Below a figure stand its captures,
steps, seeds and scale, and whether that is the protocol of the paper.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

from paper_repro.figures.data import Asked, Chosen
from paper_repro.jobs import ROWS
from paper_repro.results import Result
from paper_repro.scenes import scale_named
from pop_fast.io.atomic import write_atomically, write_file

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

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
_SIZES: Final = {"labelsize": 6.4, "major.pad": 2.0, "major.size": 2.4, "minor.size": 1.4}
_WIDTHS: Final = {"major.width": 0.6, "minor.width": 0.4}
# of both axes
_TICKS: Final[dict[Any, Any]] = {
    f"{axis}tick.{name}": value for axis in "xy" for name, value in {"color": INK, **_SIZES, **_WIDTHS}.items()
}
_EDGE: Final = 0.04
_LINE: Final = SMALL * 1.3 / 72.0


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
            **_TICKS,
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

    A thin line leads from a curve to its name where the name is not next to its end.

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


@dataclass(frozen=True)
class Drawn:
    """A figure and the numbers behind it."""

    figure: Figure  # the picture
    columns: Sequence[str]  # of the table
    rows: Sequence[Sequence[Any]]  # its lines; numbers are written unrounded


class Sheet:
    """A figure of a given width, with panels in inches and a note below them.

    Args:
        note: what stands below.
        height: of everything above the note, inches.
        width: of the figure, inches.
    """

    def __init__(self, note: str, height: float, width: float = COLUMN) -> None:
        from matplotlib.figure import Figure

        self.width, self.height = width, height
        lines = _wrapped(note, width - 2.0 * _EDGE)
        self._below = len(lines) * _LINE + _EDGE * 2.0
        self.figure: Figure = Figure(figsize=(width, height + self._below))
        self.figure.text(
            _EDGE / width,
            (self._below - _EDGE) / (height + self._below),
            "\n".join(lines),
            size=SMALL,
            color=GREY,
            va="top",
            linespacing=1.25,
        )

    def axes(self, left: float, bottom: float, width: float, height: float, **more: Any) -> Axes:
        """Add axes; all in inches, from the lower left corner of what is above the note."""
        whole = self.height + self._below
        place = (left / self.width, (bottom + self._below) / whole, width / self.width, height / whole)
        return self.figure.add_axes(place, **more)

    def panel(self, left: float = 0.44, right: float = 0.08, top: float = 0.08, bottom: float = 0.33) -> Axes:
        """Add axes that fill what is above the note, but for room around them for ticks and labels, inches."""
        return self.axes(left, bottom, self.width - left - right, self.height - bottom - top)


def show(axes: Axes, picture: np.ndarray, **more: Any) -> AxesImage:
    """Show a picture over the whole of its axes, every pixel as it is where there is room, else averaged."""
    from matplotlib.transforms import Bbox

    place: Bbox = axes.get_window_extent()
    scale = SAVED_DPI / axes.figure.dpi
    fits = picture.shape[1] <= place.width * scale and picture.shape[0] <= place.height * scale
    axes.set_axis_off()
    return axes.imshow(picture, interpolation="none" if fits else "antialiased", aspect="auto", **more)


def save(drawn: Drawn, stem: Path) -> list[Path]:
    """Write stem.svg, stem.png and stem.csv; the PNG's text "Source" is the hash of the CSV.

    Raises:
        PopError: a file cannot be written.
    """
    paths = [stem.with_name(f"{stem.name}.{suffix}") for suffix in ("svg", "png", "csv")]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(drawn.columns)
    writer.writerows([_cell(value) for value in row] for row in drawn.rows)
    numbers = text.getvalue().encode("utf-8")
    write_atomically(paths[0], partial(_write_svg, drawn.figure))
    said = {"Software": None, "Source": f"sha256:{hashlib.sha256(numbers).hexdigest()}"}
    more: dict[str, Any] = {"metadata": said, "pil_kwargs": {"optimize": True}}
    write_atomically(paths[1], partial(drawn.figure.savefig, format="png", **more))
    write_file(paths[-1], numbers)
    return paths


def _write_svg(figure: Any, file: BinaryIO) -> None:
    """Write a figure as SVG with one line a path, where matplotlib writes one line a point."""
    drawn = io.StringIO()
    # no date: the same numbers are the same bytes
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    file.write(_compact(drawn.getvalue()).encode("utf-8"))


def _compact(text: str) -> str:
    """Join the lines inside a tag, and leave out what indents tags and what ends groups on lines of their own."""
    joined = re.sub(r"\s*\n(?!\s*<)", " ", text)
    return re.sub(r"\n\s*(</|<use|<path|<g>)", r"\1", re.sub(r"\n\s+<", "\n<", joined))


def _cell(value: Any) -> Any:
    # a NumPy number says its type in its repr
    return repr(float(value)) if isinstance(value, float) else value


def _wrapped(text: str, width: float) -> list[str]:
    """Break a text into lines of at most a width, inches."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextToPath

    font, measure = FontProperties(size=SMALL), TextToPath()
    lines: list[str] = []
    # not at the spaces that must not break
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and measure.get_text_width_height_descent(longer, font, ismath=False)[0] <= width * 72.0:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def foot(asked: Asked, chosen: Chosen, *more: str, averaged: bool = True) -> str:
    """Write the note of a figure.

    Args:
        asked: what is drawn.
        chosen: of which results.
        more: sentences of the figure's own, in front of the others.
        averaged: whether it shows means over the captures.
    """
    sentences = [*more, *foot_of(asked.scale, chosen.all, averaged)]
    if chosen.left_out:
        sentences.append(f"Not every row was run on {_listed(chosen.left_out)}.")
    if chosen.missing:
        sentences.append(f"Not run: {_listed(map(name_of, chosen.missing))}.")
    return " ".join(sentences)


def foot_of(scale: str, results: Sequence[Result], averaged: bool = True) -> list[str]:
    """Say captures, steps and seeds of results, and the scale."""
    sizes = {
        r.scene: f"{r.scene} ({r.protocol['width']}\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}{r.protocol['height']})"
        for r in results
    }
    steps = sorted({int(r.schedule["max_steps"]) for r in results})
    of_them = "Capture" if len(sizes) == 1 else "Mean over" if averaged else "Captures"
    captures = f"{of_them} {_listed(sizes.values())}"
    length = " to ".join(f"{n:,}" for n in dict.fromkeys((steps[0], steps[-1])))
    return [f"{captures}; {length} steps; {_seeded(results)}.", scale_sentence(scale)]


def _seeded(results: Sequence[Result]) -> str:
    """Say what results are means over: the same seeds each, or some of these."""
    of_each: dict[tuple[str, str], set[int]] = {}
    for r in results:
        of_each.setdefault((r.row, r.scene), set()).add(r.seed)
    seeds = _listed(map(str, sorted(set().union(*of_each.values()))))
    counts = sorted({len(each) for each in of_each.values()})
    if any(each != next(iter(of_each.values())) for each in of_each.values()):
        many = (
            "one seed"
            if counts == [1]
            else f"means over {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))} seeds"
        )
        return f"{many} each, of {seeds}"
    return f"seed {seeds}" if counts == [1] else f"mean over seeds {seeds}"


def scale_sentence(scale: str) -> str:
    """Say whether a scale is the paper's protocol."""
    if scale == "paper":
        return "Scale paper: the published protocol."
    return f"Scale {scale}, not the paper's protocol: {scale_named(scale).about}."


def _listed(names: Iterable[str]) -> str:
    found = list(names)
    return found[0] if len(found) == 1 else f"{', '.join(found[:-1])} and {found[-1]}"
