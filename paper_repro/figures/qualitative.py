"""Figure 5: renders of held-out views by POP and 3DGS next to the photographs, with the place where they differ most.

The renders are those that a run keeps in its work folder. Photographs of captures appear in this figure, so it is drawn
where the captures are, and only that of the demo capture, which is ray-traced, belongs into the repository.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import dist
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from paper_repro.figures.data import Asked, Chosen, NoDataError
from paper_repro.figures.style import INK, TEXT, Drawn, Sheet, color_of, foot, name_of, show
from paper_repro.results import Result
from pop_fast.view.report.source import read_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SCENES: Final = ("truck", "train", "playroom", "bonsai")
_ROWS: Final = ("pop", "3dgs")
_GAP, _TITLE, _SIDE = 0.06, 0.17, 0.15
# the highest that a photograph is shown, and the height of an enlargement in it, inches
_HIGHEST, _INSET = 1.75, 0.62
_BOX: Final = "#E1261C"


@dataclass(frozen=True)
class ComparedView:
    """One held-out view of a scene."""

    scene: str  # its name
    name: str  # of the photograph
    photo: np.ndarray  # uint8 [H, W, 3]
    renders: dict[str, np.ndarray]  # by row, uint8 [H, W, 3]
    psnr: dict[str, float]  # of this view, by row, dB
    box: tuple[int, int, int]  # x, y and side of the square in which the renders differ most, px


def renders_and_photographs(asked: Asked) -> Drawn:
    """Figure 5: a line a scene, POP, 3DGS and the photograph side by side."""
    scenes = asked.scenes(_SCENES)[:4]
    runs = {(r.row, r.scene): r for r in reversed(asked.results) if r.row in _ROWS and r.scene in scenes}
    views = [view for scene in scenes if (view := _view(asked, runs, scene)) is not None]
    if not views:
        raise NoDataError(
            f"figure 5 at scale {asked.scale} is not drawn: there is no scene of {', '.join(scenes)} with results of "
            f"{' and '.join(_ROWS)} whose renders are in {asked.work}; give the folder that they were trained in with "
            f"--work, or train them with pop-repro queue --scale {asked.scale} --data DATA --rows {' '.join(_ROWS)} "
            f"--scenes {scenes[0]} --results NEW, and draw the figure with --results NEW"
        )
    shown = tuple(view.scene for view in views)
    not_run = tuple(scene for scene in scenes if any((row, scene) not in runs for row in _ROWS))
    elsewhere = [scene for scene in scenes if scene not in (*shown, *not_run)]
    chosen = Chosen({row: {scene: (runs[row, scene],) for scene in shown} for row in _ROWS}, shown, (), not_run)
    note = foot(
        *(asked, chosen),
        "The first held-out view of each capture, PSNR of this view alone. Box: where the two renders differ most, "
        "whichever is better; enlarged beside it.",
        *([f"The work folder has no renders of {', '.join(elsewhere)}."] if elsewhere else []),
        averaged=False,
    )
    return Drawn(_drawn(views, note), *_table(views, runs))


def most_different(one: np.ndarray, other: np.ndarray, side: int) -> tuple[int, int]:
    """Find the square in which two images differ most.

    Args:
        one: uint8 [H, W, 3]
        other: uint8 [H, W, 3]
        side: of the square, px.

    Returns:
        x and y of its upper left pixel.
    """
    squares = ((one.astype(np.float64) - other.astype(np.float64)) ** 2).sum(axis=2)
    sums = np.pad(squares.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    inside = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    y, x = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(x), int(y)


def _view(asked: Asked, runs: dict[tuple[str, str], Result], scene: str) -> ComparedView | None:
    """Read what both rows have kept of the first held-out view; None where one has not."""
    found: dict[str, Any] = {}
    for row in _ROWS:
        if (row, scene) not in runs:
            return None
        folder = asked.work / asked.scale / row / f"{scene}_{runs[row, scene].seed}" / "report_data"
        kept = sorted(folder.glob("val_step*_0000.npz"))
        if not kept:
            return None
        found[row] = read_view(kept[-1])
        told = runs[row, scene].per_view.get(str(found[row]["name"]), {})
        if not np.isclose(float(found[row]["psnr"]), told.get("psnr", np.nan), rtol=0.0, atol=1e-6, equal_nan=True):
            # those of another run of the row
            return None
    photo, renders = found["pop"]["photo"], {row: found[row]["render"] for row in _ROWS}
    side = max(min(photo.shape[:2]) // 4, 1)
    psnr = {row: float(found[row]["psnr"]) for row in _ROWS}
    place = most_different(renders["pop"], renders["3dgs"], side)
    return ComparedView(scene, str(found["pop"]["name"]), photo, renders, psnr, (*place, side))


def _drawn(views: Sequence[ComparedView], note: str) -> Any:
    width = (TEXT - _SIDE - 2.0 * _GAP) / 3.0
    heights = [min(width * v.photo.shape[0] / v.photo.shape[1], _HIGHEST) for v in views]
    sheet = Sheet(note, _TITLE + sum(heights) + _GAP * len(views), TEXT)
    top = sheet.height - _TITLE
    for i, (view, height) in enumerate(zip(views, heights, strict=True)):
        pictures = [*view.renders.values(), view.photo]
        labels = [f"{view.psnr[row]:.2f} dB" for row in _ROWS] + [""]
        for j, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
            left = _SIDE + j * (width + _GAP)
            of_image = height * picture.shape[1] / picture.shape[0]
            axes = sheet.axes(left, top - height, of_image, height)
            show(axes, picture)
            _boxed(axes, view, label)
            _enlarged(sheet, picture, view, (left, top - height, of_image, height), width)
            if i == 0:
                title = (*map(name_of, _ROWS), "photograph")[j]
                axes.set_title(title, color=color_of(_ROWS[j]) if j < 2 else INK)
            if j == 0:
                axes.text(-0.02, 0.5, view.scene, transform=axes.transAxes, rotation=90, ha="right", va="center")
        top -= height + _GAP
    return sheet.figure


def _boxed(axes: Axes, view: ComparedView, label: str) -> None:
    from matplotlib.patches import Rectangle

    x, y, side = view.box
    axes.add_patch(Rectangle((x - 0.5, y - 0.5), side, side, fill=False, edgecolor=_BOX, linewidth=0.9))
    if label:
        axes.text(
            *(0.02, 0.03, label),
            transform=axes.transAxes,
            size=6.4,
            color="white",
            va="bottom",
            bbox={"facecolor": "black", "alpha": 0.55, "edgecolor": "none", "pad": 1.4},
        )


def _enlarged(
    sheet: Sheet, picture: np.ndarray, view: ComparedView, place: tuple[float, float, float, float], width: float
) -> None:
    """Show the box enlarged: beside a narrow picture, else in that corner of a wide one that is farthest from it."""
    from matplotlib.patches import Rectangle

    left, bottom, of_image, height = place
    x, y, side = view.box
    spare = width - of_image - _GAP
    if spare > _INSET:
        size = min(spare, height)
        corner = (left + of_image + _GAP, bottom + height - size)
    else:
        size = min(_INSET, height / 2.0)
        middle = (
            left + (x + side / 2.0) * of_image / picture.shape[1],
            bottom + height * (1.0 - (y + side / 2.0) / picture.shape[0]),
        )
        right, upper = left + of_image - size, bottom + height - size
        # the lower left corner has the PSNR
        corner = max(
            ((left, upper), (right, upper), (right, bottom)),
            key=lambda c: dist((c[0] + size / 2.0, c[1] + size / 2.0), middle),
        )
    axes = sheet.axes(*corner, size, size)
    show(axes, picture[y : y + side, x : x + side])
    # half of a line on the edge of the axes is cut off
    axes.add_patch(Rectangle((0, 0), 1, 1, transform=axes.transAxes, fill=False, edgecolor=_BOX, linewidth=1.4))


def _table(
    views: Sequence[ComparedView], runs: dict[tuple[str, str], Result]
) -> tuple[Sequence[str], Sequence[Sequence[Any]]]:
    rows = [(v.scene, row, v.name, v.psnr[row], *v.box, runs[row, v.scene].run) for v in views for row in _ROWS]
    return ("scene", "row", "view", "psnr", "box_x", "box_y", "box_side", "run"), rows
