"""Figures of results that were never run, and what stands in them."""

from __future__ import annotations

from pathlib import Path

from paper_repro.figures import FIGURES, curves, opacities, style, tradeoffs
from paper_repro.figures.data import Asked
from paper_repro.figures.sheet import Drawn
from paper_repro.results import Result


def asked(figure: str, results: list[Result], folder: Path = Path("nowhere"), scale: str = "small") -> Asked:
    return Asked(figure, scale, [r for r in results if r.scale == scale], folder, folder)


def drawn(figure: str, results: list[Result], **more) -> Drawn:
    """Draw one figure of results that are nowhere on the disk."""
    module = {"tradeoffs": tradeoffs, "opacities": opacities, "curves": curves}[FIGURES[figure][0]]
    with style.look():
        return getattr(module, FIGURES[figure][1])(asked(figure, results, **more))


def lines(made: Drawn) -> list[dict]:
    return [dict(zip(made.columns, row, strict=True)) for row in made.rows]


def texts(made: Drawn) -> str:
    """Read all that is written in a figure."""
    from matplotlib.text import Text

    return "\n".join(found.get_text() for found in made.figure.findobj(Text))
