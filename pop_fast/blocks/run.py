"""The parts of a run in blocks that read the capture: its division at the start, and the merge at the end.

Neither holds all photographs: the division reads none, the merge those that are held out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Final

import numpy as np

from pop_fast.blocks.jobs import Part, block_folder, result_of
from pop_fast.blocks.merge import merge
from pop_fast.blocks.plan import FOLDER, Job, Plan, make_plan, write_plan
from pop_fast.data.capture import Capture, Listing, Progress, SfmOptions
from pop_fast.data.load import Photographs, list_capture, load_capture
from pop_fast.io.atomic import write_atomically
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureRecord
from pop_fast.train.refining import refining

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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


class Division:
    """A capture and how it is divided, in memory until `write`.

    Attributes:
        capture: its cameras and points, without photographs.
        plan: its blocks.
    """

    def __init__(self, capture: Capture, listing: Listing, plan: Plan) -> None:
        self.capture, self.plan, self._listing = capture, plan, listing

    def write(self, folder: Path) -> None:
        """Write blocks, map and plan into a result folder."""
        (folder / FOLDER).mkdir(parents=True, exist_ok=True)
        write_map(folder / FOLDER / "map.png", self.capture, self.plan)
        write_plan(folder, self.plan, self._listing, self.capture.world_transform)


def divide_capture(
    config: TrainConfig,
    record: CaptureRecord,
    job: Job,
    sfm: bool | SfmOptions = False,
    progress: Progress | None = None,
) -> Division:
    """Read a capture's cameras and points, and divide it.

    Args:
        config: the settings of the run.
        record: how the capture is read.
        job: what was asked for.
        sfm: how the cameras of bare photographs are found.
        progress: is called with (stage, done, total).

    Raises:
        PopError: the capture cannot be read, or not be divided as asked for.
    """
    listing = list_capture(config.data, record.source, record.images, sfm, progress)
    capture = _load(config, record, "none", progress, listing)
    return Division(capture, listing, make_plan(capture, job, config.test_every))


def merge_capture(
    folder: Path, config: TrainConfig, record: CaptureRecord, part: Part, progress: Progress | None = None
) -> tuple[Capture, dict[str, Any]]:
    """Merge the blocks of a round and measure the held-out views of the whole capture; see `merge`.

    Returns:
        The capture, whose held-out photographs alone have been read, and the statistics.
    """
    capture = _load(config, record, "held out", progress)
    return capture, merge(folder, config, capture, part)


def config_of(folder: Path, config: TrainConfig, name: str) -> TrainConfig:
    """Return the settings of a block's training: those of the run, on the block's list and in its folder."""
    return replace(config, data=str(folder / FOLDER / name), result_dir=str(result_of(folder, name)))


def round_config(folder: Path, config: TrainConfig, part: Part, steps: int) -> TrainConfig:
    """Return the settings of a block's training in a round from 1: they continue where those of the run have ended.

    Args:
        folder: the run's.
        config: its settings.
        part: which block, in which round; each round draws another order of views.
        steps: of the round.
    """
    if part.block is None:
        raise ValueError("a merge is no training")
    place = block_folder(folder, part.block, part.round)
    where = {"data": str(place), "result_dir": str(result_of(folder, part.block, part.round))}
    return replace(refining(config, steps), **where, seed=config.seed + part.round)


def _load(
    config: TrainConfig,
    record: CaptureRecord,
    photographs: Photographs,
    progress: Progress | None,
    listing: Listing | None = None,
) -> Capture:
    return load_capture(
        config.data,
        factor=config.factor,
        normalize=config.normalize,
        masks=record.masks,
        missing=record.missing,
        background=config.background,
        progress=progress,
        source=record.source,
        images=record.images,
        resize=config.resize,
        seed=config.seed,
        photographs=photographs,
        test_every=config.test_every,
        listing=listing,
    )
