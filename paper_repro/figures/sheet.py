"""A figure on its sheet: axes of a size in inches above a note, and the files that it is saved as."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal

from paper_repro.figures.style import COLUMN, GREY, SAVED_DPI, SMALL
from pop_fast.io.atomic import write_atomically

if TYPE_CHECKING:
    import numpy as np
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_EDGE: Final = 0.04
_LINE: Final = SMALL * 1.3 / 72.0


@dataclass(frozen=True)
class Drawn:
    """A figure and the numbers behind it.

    Attributes:
        figure: the picture.
        columns: of the table.
        rows: its lines; numbers are written unrounded.
    """

    figure: Figure
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True)
class Margins:
    """Room around the axes for ticks and labels, inches."""

    left: float = 0.44
    right: float = 0.08
    top: float = 0.08
    bottom: float = 0.33


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

    def panel(self, margins: Margins | None = None) -> Axes:
        """Add axes that fill what is above the note, but for the margins."""
        m = Margins() if margins is None else margins
        return self.axes(m.left, m.bottom, self.width - m.left - m.right, self.height - m.bottom - m.top)


def show(axes: Axes, picture: np.ndarray, **more: Any) -> AxesImage:
    """Show a picture over the whole of its axes, every pixel as it is where there is room, else averaged."""
    from matplotlib.transforms import Bbox

    place: Bbox = axes.get_window_extent()
    scale = SAVED_DPI / axes.figure.dpi
    fits = picture.shape[1] <= place.width * scale and picture.shape[0] <= place.height * scale
    axes.set_axis_off()
    return axes.imshow(picture, interpolation="none" if fits else "antialiased", aspect="auto", **more)


def save(drawn: Drawn, stem: Path) -> list[Path]:
    """Write stem.svg, stem.png and stem.csv.

    Raises:
        PopError: a file cannot be written.
    """
    formats: tuple[Literal["svg", "png"], ...] = ("svg", "png")
    paths = [stem.with_name(f"{stem.name}.{suffix}") for suffix in (*formats, "csv")]
    for suffix, path in zip(formats, paths, strict=False):
        if suffix == "svg":
            write_atomically(path, partial(_write_svg, drawn.figure))
        else:
            more: dict[str, Any] = {"metadata": {"Software": None}, "pil_kwargs": {"optimize": True}}
            write_atomically(path, partial(drawn.figure.savefig, format=suffix, **more))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(drawn.columns)
    writer.writerows([_cell(value) for value in row] for row in drawn.rows)
    write_atomically(paths[-1], lambda file: file.write(text.getvalue().encode("utf-8")))
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
