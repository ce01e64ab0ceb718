"""The paper's nine figures from the results: each as SVG, as PNG, and the numbers behind it as CSV.

Fonts, colours, sizes and what a figure says below itself are in `style`, what it takes of the results is in
`data`. Nothing is drawn of what was not run: a figure names the rows that it lacks, and one without any is refused.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Final

from pop_fast.errors import PopError

# each with its module and function, and its title
FIGURES: Final = {
    "1": ("tradeoffs", "psnr_against_time", "PSNR against training time"),
    "2": ("curves", "opacity_histogram", "Opacities of 3DGS"),
    "3": ("artifact", "six_panels", "What becomes of 3DGS when every opacity is pushed to 1"),
    "4a": ("curves", "gradients_of_losses", "Gradients of the losses"),
    "4b": ("curves", "gaussians_per_pixel", "Gaussians per pixel"),
    "5": ("qualitative", "renders_and_photographs", "Renders next to the photographs"),
    "6a": ("curves", "count_under_losses", "Gaussians under different losses"),
    "6b": ("tradeoffs", "psnr_against_count", "PSNR against the number of Gaussians"),
    "7": ("curves", "count_of_methods", "Gaussians of every method"),
}


def draw(
    figure: str, scale: str, results: Path, out: Path, work: Path | None = None, data: Path | None = None
) -> list[Path]:
    """Draw a figure.

    Args:
        figure: its number in the paper.
        scale: whose results to take.
        results: the folder of results.
        out: where figure_N.svg, figure_N.png and figure_N.csv go.
        work: the folder of checkpoints, which has the renders of finished rows; None takes the usual one.
        data: the folder that holds the scenes, for what has to be trained or rendered anew; None for no scene but the
            demo.

    Returns:
        The three files.

    Raises:
        PopError: there is no such figure or scale.
        NoDataError: nothing of what it shows was run; names it.
    """
    if figure not in FIGURES:
        raise PopError(f"figure is '{figure}'; it must be one of {', '.join(FIGURES)}")
    from paper_repro.figures.data import Asked
    from paper_repro.figures.style import look, save
    from paper_repro.jobs import WORK
    from paper_repro.results import read_all

    module, function, _ = FIGURES[figure]
    asked = Asked(figure, scale, read_all(scale, results), WORK if work is None else work, data or Path("data"))
    with look():
        drawn = getattr(importlib.import_module(f"paper_repro.figures.{module}"), function)(asked)
        return save(drawn, out / f"figure_{figure}")
