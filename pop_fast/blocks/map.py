"""A picture of how a capture is divided, seen from above."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np

from pop_fast.blocks.plan import Plan
from pop_fast.data.capture import Capture
from pop_fast.io.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["write_map"]

# enough to see the ground by
_MOST_POINTS: Final = 20_000
# of the points, on either side, left out of the picture: far ones would shrink the rest
_FAR: Final = 0.02


def write_map(path: Path, capture: Capture, plan: Plan) -> None:
    """Draw cameras and points on the ground, each in its block's colour, cores as lines and margins as dashes.

    Args:
        path: the PNG.
        capture: its cameras and points.
        plan: how it is divided.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 7.0), dpi=120, layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    low, high = _frame(capture, plan)
    _draw_points(axes, capture, plan)
    for number, block in enumerate(plan.blocks):
        core = _drawn(plan.partition.box(number), low, high)
        wider = _drawn(plan.partition.box(number, plan.job.margin), low, high)
        color = _color(number)
        axes.plot(*_outline(wider), "--", color=color, linewidth=1.0)
        axes.plot(*_outline(core), "-", color="black", linewidth=1.2)
        text = f"{block.name}\n{len(block.views)} views, {len(block.points):,} points"
        across, along = core.mean(axis=1)
        axes.text(across, along, text, ha="center", va="center", fontsize=8, bbox={"fc": "white", "alpha": 0.7})
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="first axis of the ground", ylabel="second axis")
    axes.set_title(
        f"{capture.name} in {plan.job.blocks}: points, cameras (triangles), cores, margins (dashed)", fontsize=9
    )
    canvas = FigureCanvasAgg(figure)

    def write(file: BinaryIO) -> None:
        # without the date and version that matplotlib would add, so that the same plan is the same file
        canvas.print_png(file, metadata={"Software": None})

    write_atomically(path, write)


def _draw_points(axes: Axes, capture: Capture, plan: Plan) -> None:
    every = max(len(capture.points) // _MOST_POINTS, 1)
    points = capture.points[::every]
    for places, block, style in (
        (points, plan.partition.block_of(points), {"marker": ".", "s": 1.0, "alpha": 0.5}),
        (capture.camera_centers, plan.partition.block_of(capture.camera_centers), {"marker": "^", "s": 14.0}),
    ):
        ground = plan.partition.on_ground(places)
        colors: Any = [_color(number) for number in block]
        axes.scatter(*ground.T, c=colors, **style)


def _frame(capture: Capture, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    cameras = plan.partition.on_ground(capture.camera_centers)
    points = np.quantile(plan.partition.on_ground(capture.points), [_FAR, 1.0 - _FAR], axis=0)
    every = np.concatenate([cameras, points])
    low, high = every.min(axis=0), every.max(axis=0)
    room = 0.05 * max(float((high - low).max()), 1e-9)
    return low - room, high + room


def _drawn(box: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.clip(box, low[:, None], high[:, None])


def _outline(box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    (left, right), (bottom, top) = box
    return np.array([left, right, right, left, left]), np.array([bottom, bottom, top, top, bottom])


def _color(number: int) -> str:
    return f"C{number % 10}"
