"""How the pictures look: five colours that the pages know in a light and in a dark form, and axes to draw on."""

from __future__ import annotations

from typing import Any, Final

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.rcsetup import cycler

INK: Final = "#1d1c1a"
MUTED: Final = "#6b6862"
RULE: Final = "#dedbd4"
ACCENT: Final = "#2563c9"
SECOND: Final = "#d2622a"
THIRD: Final = "#23835a"

# negative, zero, positive; and none, much: what is nothing is transparent, so that it suits light and dark pages
DIVERGING: Final = LinearSegmentedColormap.from_list(
    "diverging", [(0.0, f"{SECOND}ff"), (0.5, f"{MUTED}10"), (1.0, f"{ACCENT}ff")]
)
MUCH: Final = LinearSegmentedColormap.from_list("much", [f"{ACCENT}00", f"{ACCENT}ff"])

# what the pages' style sheet calls them; it gives each a form for dark screens
VARIABLES: Final = {
    INK: "var(--ink)",
    MUTED: "var(--soft)",
    RULE: "var(--rule)",
    ACCENT: "var(--c1)",
    SECOND: "var(--c2)",
    THIRD: "var(--c3)",
}

_SETTINGS: Final[dict[Any, Any]] = {
    "axes.axisbelow": True,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.prop_cycle": cycler(color=[ACCENT, SECOND, THIRD, MUTED]),
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.titlepad": 8.0,
    "axes.titlesize": 10.0,
    "figure.constrained_layout.use": True,
    "figure.facecolor": "none",
    "font.size": 9.0,
    "grid.color": RULE,
    "grid.linewidth": 0.6,
    "image.cmap": "cividis",
    "image.interpolation": "nearest",
    "legend.frameon": False,
    "legend.labelcolor": INK,
    "lines.linewidth": 1.8,
    "svg.fonttype": "path",
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": MUTED,
    "ytick.color": MUTED,
    "ytick.labelcolor": MUTED,
}


def apply() -> None:
    """Set matplotlib up for the walk-through: its style, and no windows."""
    mpl.use("Agg")
    mpl.rcParams.update(_SETTINGS)


def axes(
    n_columns: int = 1,
    n_rows: int = 1,
    width: float = 7.2,
    height: float | None = None,
    ticks: bool = True,
    **options: Any,
) -> tuple[Figure, Any]:
    """Make a figure as wide as the page's text and axes on it.

    Args:
        n_columns: panels side by side.
        n_rows: rows of panels.
        width: inches; 7.2 fills the page.
        height: inches, default 0.95 of a panel's width per row, at most 3.2.
        ticks: False for pictures, whose axes need no numbers.
        options: passed to `plt.subplots`, for example `sharey=True` or `width_ratios=[2, 1]`.

    Returns:
        The figure; and one Axes, or an array of them in row-major order where there are several.
    """
    apply()
    panel = min(0.95 * width / n_columns, 3.2)
    size = (width, panel * n_rows if height is None else height)
    bare = {} if ticks else {"subplot_kw": {"xticks": [], "yticks": []}}
    figure, panels = plt.subplots(n_rows, n_columns, figsize=size, **bare, **options)
    return figure, panels.ravel() if isinstance(panels, np.ndarray) else panels


def show_image(ax: Any, image: np.ndarray, title: str = "", **options: Any) -> Any:
    """Show an image in screen coordinates: x right and y down in px, pixel centres at index + 0.5.

    Args:
        ax: where to draw.
        image: [H, W, 3] encoded rgb, clipped to [0, 1] here, or [H, W] numbers for a colour map.
        title: above it.
        options: passed to `imshow`, for example `cmap`, `vmin`, `vmax`.

    Returns:
        What `imshow` returns, for a colour bar.
    """
    height, width = image.shape[:2]
    shown = np.clip(image, 0.0, 1.0) if image.ndim == 3 else image
    drawn = ax.imshow(shown, extent=(0, width, height, 0), **options)
    ax.set_title(title)
    ax.grid(False)
    return drawn
