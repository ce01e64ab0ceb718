"""The parts of a run in blocks that read the capture: its division at the start, and the merges of trained blocks.

Neither holds all photographs: the division reads none, a merge only those that are held out. From each block a merge
takes only the Gaussians of its core; after the separate trainings these are the Gaussians whose centre is in it. In a
round a block corrects the errors that its photographs still show, as if no other block did. Where a view shows two
cores, both blocks correct the same error, so a merge applies only a share (`TAKEN`) of what a round has changed. The
last merge makes the run's result, and every other merge the start of the next round.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from torch import Tensor

from pop_fast.blocks.jobs import Part, block_folder, core_of, result_of, round_folder
from pop_fast.blocks.plan import COARSE, FOLDER, Job, Partition, Plan, make_plan, read_job, read_plan, write_plan
from pop_fast.blocks.rounds import own_of
from pop_fast.data.capture import Capture, Listing, Progress, SfmOptions
from pop_fast.data.load import Photographs, list_capture, read_block
from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically, write_json
from pop_fast.io.ply import Frame, save_ply
from pop_fast.io.read_back import read_json
from pop_fast.train.checkpoint import checkpoint_path, load_splats, save_checkpoint
from pop_fast.train.config import LearningRates, TrainConfig
from pop_fast.train.engines import renderer
from pop_fast.train.environment import peak_memory_bytes, reproducible, run_facts
from pop_fast.train.evaluate import evaluate, population
from pop_fast.train.load_result import CaptureRecord, load_as_recorded, load_splat
from pop_fast.train.lpips import load_nets
from pop_fast.train.model import KEYS
from pop_fast.train.presets import QUICK_BETA2, QUICK_DECAY, QUICK_RATES, QUICK_SCALER
from pop_fast.train.results import ResultFolder, read_config
from pop_fast.train.schedule import active_sh_degree, refining
from pop_fast.train.views import ViewTensors
from pop_ref.settings import Recipe

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# enough to see the ground by
_MOST_POINTS: Final = 20_000
# of the points, on either side, left out of the picture: far ones would shrink the rest
_FAR: Final = 0.02


def write_map(path: Path, capture: Capture, plan: Plan) -> None:
    """Draw cameras and points on the ground, each in its block's colour, cores as lines and margins as dashes."""
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
    # without the date and version that matplotlib would add, so that the same plan is the same file
    write_atomically(path, partial(FigureCanvasAgg(figure).print_png, metadata={"Software": None}))


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

    Raises:
        PopError: the capture cannot be read, or not be divided as asked for.
    """
    listing = list_capture(config.data, record.source, record.images, sfm, progress)
    capture = _load(config, record, "none", progress, listing)
    return Division(capture, listing, make_plan(capture, job, config.test_every))


def merge_capture(
    folder: Path, config: TrainConfig, record: CaptureRecord, part: Part, progress: Progress | None = None
) -> tuple[Capture, dict[str, Any]]:
    """Merge the blocks of a round; see `merge`. Also gives the capture, of which held-out photographs were read."""
    capture = _load(config, record, "held out", progress)
    return capture, merge(folder, config, capture, part)


def config_of(folder: Path, config: TrainConfig, name: str) -> TrainConfig:
    """Return the settings of a block's training: those of the run, on the block's list and in its folder."""
    return replace(config, data=str(folder / FOLDER / name), result_dir=str(result_of(folder, name)))


# settings that say how long a training is, which a coarse model's are not taken from
_OF_LENGTH: Final = frozenset(
    {"max_steps", "eval_steps", "save_steps", "sh_interval", "l2_stop_iter", "coarse_stop_iters", "result_dir"}
)


def coarse_config(folder: Path, config: TrainConfig, by: int) -> TrainConfig:
    """Return the settings of a run's coarse model: preset "quick", on photographs shrunk by a further factor.

    It takes no more steps than the run has.

    The low-pass is that of the whole photographs, whose pixels are smaller. With the profile's own, which is as wide in
    larger pixels, Gaussians become thinner than whole photographs show them: on bonsai, shrunk by 2, the coarse model
    had 25.29 dB at the whole size, and has 28.03.

    Args:
        by: the further factor.

    Raises:
        PopError: the run says nothing of what its settings follow from.
    """
    given = config.given
    if given is None:
        raise PopError(f"{folder}: its settings do not say what they follow from; start it with pop train --blocks")
    names = ((name, name.rpartition(".")[2]) for name in given.settings)
    kept = {n: given.settings[n] for n, last in names if n not in _OF_LENGTH and not last.endswith(("_iter", "_every"))}
    scaler = min(QUICK_SCALER, config.max_steps / Recipe.max_steps)
    quick = TrainConfig.of(method=given.method, preset="quick", steps_scaler=scaler, **kept)
    where = {"data": str(folder / FOLDER / COARSE), "result_dir": str(result_of(folder, COARSE))}
    finer = {"factor": by * config.factor, "eps2d": config.renderer.eps2d / by**2, "near_plane": config.near_plane}
    return replace(quick, given=None, **where, **finer, threads=config.threads, backend=config.backend)


# what the rates of a round that follows a coarse model are multiplied by, which has more to learn than merged blocks:
# two fifths of preset "quick"; like those they fall to a tenth. Centres begin with twice the rate of other rounds. On
# bonsai in 2x2 the first round of 300 steps made 28.49 dB of 28.03 without this, and 28.58 dB with it
_AFTER_COARSE: Final = 0.4
_MEANS_AFTER_COARSE: Final = 2.0


def _hurried(lr: LearningRates) -> LearningRates:
    """Return the rates of a round after a coarse model."""
    times = {name: _AFTER_COARSE * by for name, by in QUICK_RATES.items() if name != "means"}
    rates = {name: by * getattr(lr, name) for name, by in times.items()}
    means = {"means": _MEANS_AFTER_COARSE * lr.means, "means_decay": lr.means_decay / _MEANS_AFTER_COARSE}
    return replace(lr, **rates, **means, others_decay=QUICK_DECAY, beta2=QUICK_BETA2)


def round_config(folder: Path, config: TrainConfig, part: Part, job: Job) -> TrainConfig:
    """Return a block's settings in a round from 1: they go on where the run has ended, in another order of views."""
    if part.block is None:
        raise ValueError("a merge is no training")
    place = block_folder(folder, part.block, part.round)
    where = {"data": str(place), "result_dir": str(result_of(folder, part.block, part.round))}
    found = refining(config, job.round_steps)
    return replace(found, **where, seed=config.seed + part.round, lr=_hurried(found.lr) if job.coarse else found.lr)


def _load(
    config: TrainConfig,
    record: CaptureRecord,
    photographs: Photographs,
    progress: Progress | None,
    listing: Listing | None = None,
) -> Capture:
    fix = "put the capture back as it was, or train again with --overwrite"
    return load_as_recorded(config, record, config.result_dir, fix, progress, photographs, listing)


# of what a round has changed. On bonsai in 2x2, where all four cores stand in most views, a round of 300 steps that
# draws from all views made 27.69, 27.92 and 27.56 dB of 26.49 dB with shares of 0.5, 0.75 and 1; on fox in 2x1 it made
# 30.60, 30.60 and 30.53 dB of 30.30 dB
TAKEN: Final = 0.75
# what a block's statistics say of the settings, which are those of all
_SETTINGS: Final = ("method", "preset", "seed", "lambda_pop", "blur_min_pixels", "blur_events", "stepper")


def kept_of(partition: Partition, number: int, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the rows of a block's Gaussians whose centre is in its core.

    Every centre is in one core, so that what different blocks keep never overlaps.
    """
    kept = torch.from_numpy(partition.block_of(params["means"].double().numpy()) == number)
    return {key: value[kept] for key, value in params.items()}


def moved(before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return Gaussians moved by the share `TAKEN` of the way on which a block has trained them in a round."""
    return {key: before[key].lerp(after[key], TAKEN) for key in KEYS}


def merge(folder: Path, config: TrainConfig, capture: Capture, part: Part) -> dict[str, Any]:
    """Merge the trained blocks of a round.

    The last merge writes checkpoint, PLY, pictures and statistics, as a training does at its end; one that a round
    follows writes the Gaussians of every core for it, and what they measure. One block is in memory at a time, the
    merged Gaussians, and of the capture the held-out photographs.

    Args:
        capture: the whole, of which the held-out photographs have been read.

    Returns:
        The statistics: of the last merge as in stats/val_step{step}.json, `blocks` with each block's own training and,
        where there are rounds, `rounds` with what each of them came to; of another one its entry of `rounds`.

    Raises:
        PopError: the capture is not divided, or a block is not trained to its end.
    """
    start = time.perf_counter()
    plan = read_plan(folder)
    if plan is None:
        raise PopError(f"{folder}: its capture is not divided yet; run pop blocks partition {folder}")
    partition, entries = plan
    params, rows = _gathered(folder, config, partition, entries, part)
    if len(params["means"]) == 0:
        raise PopError(f"{folder}: no block has a Gaussian in its core, so that nothing is left; look at the blocks")
    results = ResultFolder(folder)
    results.hold()
    try:
        if not part.last:
            return _hand_on(folder, config, capture, params, rows, part, partition)
        before = [read_round(folder, number) for number in range(part.round)]
        _write_splat(results, config, capture, params)
        stats = _measured(results, config, capture, params, rows, before)
    finally:
        results.close()
    stats["seconds_merging"] = time.perf_counter() - start
    results.write_stats("val", config.max_steps - 1, stats)
    return stats


Gathered = tuple[dict[str, Tensor], list[dict[str, Any]]]


def _gathered(
    folder: Path, config: TrainConfig, partition: Partition, entries: Sequence[Mapping[str, Any]], part: Part
) -> Gathered:
    if part.round:
        return _refined(folder, entries, part)
    job = read_job(folder)
    if job is not None and job.coarse:
        return _coarse(folder)
    return _trained(folder, config, partition, entries)


def _coarse(folder: Path) -> Gathered:
    """Gather what the coarse model has, and its numbers, as those of a single block."""
    result = result_of(folder, COARSE)
    splat = load_splat(result)
    last = splat.config.max_steps - 1
    if splat.step != last:
        raise PopError(f"{result}: is not trained to its end; run pop blocks train {folder} {COARSE}")
    shots = read_block(block_folder(folder, COARSE)).shots
    views = sum(shot.split == "train" for shot in shots)
    kept = len(splat.params["means"])
    row = {"name": COARSE, "training_views": views, "kept": kept, **_numbers(result, last)}
    return splat.params, [row]


def _trained(folder: Path, config: TrainConfig, partition: Partition, entries: Sequence[Mapping[str, Any]]) -> Gathered:
    """Gather what blocks that were trained by themselves have in their cores, and each one's numbers."""
    step = config.max_steps - 1
    parts: list[dict[str, Tensor]] = []
    rows: list[dict[str, Any]] = []
    for number, entry in enumerate(entries):
        result = result_of(folder, entry["name"])
        splat = load_splat(result)
        if splat.step != step:
            raise PopError(f"{result}: is not trained to its end; run pop blocks train {folder} {entry['name']}")
        parts.append(kept_of(partition, number, splat.params))
        rows.append({**entry, "kept": len(parts[-1]["means"]), **_numbers(result, step)})
    return _joined(parts), rows


def _refined(folder: Path, entries: Sequence[Mapping[str, Any]], part: Part) -> Gathered:
    """Gather the Gaussians that blocks trained in a round, and each one's numbers."""
    parts: list[dict[str, Tensor]] = []
    rows: list[dict[str, Any]] = []
    for entry in entries:
        name = entry["name"]
        result, counts = result_of(folder, name, part.round), own_of(folder, name, part.round)
        if counts["own"] == 0:
            continue
        splat = load_splat(result)
        last = splat.config.max_steps - 1
        if splat.step != last:
            again = f"pop blocks train {folder} {name} --round {part.round}"
            raise PopError(f"{result}: is not trained to its end; run {again}")
        before, _ = load_splats(core_of(folder, name, part.round - 1))
        if len(before["means"]) != counts["own"]:
            again = f"remove {result.parent} and run pop blocks train {folder} {name} --round {part.round}"
            raise PopError(f"{result}: was begun with {counts['own']} Gaussians, not {len(before['means'])}; {again}")
        parts.append(moved(before, {key: value[: counts["own"]] for key, value in splat.params.items()}))
        rows.append({"name": name, **counts, **_numbers(result, last)})
    return _joined(parts), rows


def _joined(parts: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    params = {key: torch.cat([part[key] for part in parts]) for key in KEYS}
    parts.clear()
    return params


def _hand_on(
    folder: Path,
    config: TrainConfig,
    capture: Capture,
    params: dict[str, Tensor],
    rows: Sequence[Mapping[str, Any]],
    part: Part,
    partition: Partition,
) -> dict[str, Any]:
    """Write what the next round starts from, and what it measures."""
    for number, name in enumerate(partition.names):
        content = {"step": config.max_steps - 1, "splats": kept_of(partition, number, params)}
        save_checkpoint(core_of(folder, name, part.round), content)
    stats = _of_round(part.round, _evaluated(config, capture, params), params, rows)
    write_json(_stats_path(folder, part.round), stats)
    return stats


def _of_round(
    number: int, measured: Mapping[str, Any], params: Mapping[str, Tensor], rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    return {
        "round": number,
        **{name: measured.get(name) for name in ("psnr", "ssim")},
        "num_GS": len(params["means"]),
        **{name: sum(row[name] for row in rows) for name in ("seconds", "seconds_total")},
        "memory_bytes": max(row["memory_bytes"] for row in rows),
        "blocks": list(rows),
    }


def _stats_path(folder: Path, number: int) -> Path:
    return round_folder(folder, number) / "stats.json"


def read_round(folder: Path, number: int) -> dict[str, Any]:
    """Read what a round that another one follows came to; PopError where that is absent or damaged."""
    path, fix = _stats_path(folder, number), f"run pop blocks merge {folder} --round {number}"
    if not path.is_file():
        raise PopError(f"{path}: is absent; {fix}")
    found = read_json(path, fix)
    blocks = found.get("blocks")
    if not isinstance(blocks, list) or not blocks or not all(map(_is_row, blocks)):
        raise PopError(f"{path}: blocks is not what 'pop blocks merge' writes; {fix}")
    return found


def _is_row(row: Any) -> bool:
    if not isinstance(row, dict) or not isinstance(row.get("name"), str):
        return False
    numbers = (row.get(name) for name in ("seconds", "seconds_total", "memory_bytes"))
    return all(isinstance(number, int | float) and 0.0 <= number <= sys.maxsize for number in numbers)


def _write_splat(results: ResultFolder, config: TrainConfig, capture: Capture, params: dict[str, Tensor]) -> None:
    step = config.max_steps - 1
    frame = Frame.of_training(capture.world_transform if config.normalize else None, config.drawn)
    save_ply(results.path / "ply" / f"point_cloud_{step}.ply", params, config.antialiased, frame=frame)
    # gsplat's keys alone: training is resumed from the blocks' own checkpoints
    save_checkpoint(checkpoint_path(results.path, step), {"step": step, "splats": params})
    results.write_opacities(step, params["opacities"].sigmoid().numpy())


def _measured(
    results: ResultFolder,
    config: TrainConfig,
    capture: Capture,
    params: dict[str, Tensor],
    rows: Sequence[Mapping[str, Any]],
    before: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return what the last merge measures, with what the rounds before it came to."""
    step = config.max_steps - 1
    first = before[0]["blocks"] if before else rows
    folders = [result_of(results.path, row["name"]) for row in first]
    # a coarse model has steps of its own
    trained = [_results_stats(place, read_config(place).max_steps - 1) for place in folders]
    stats: dict[str, Any] = {
        "step": step,
        **{name: trained[0][name] for name in _SETTINGS if name in trained[0]},
        "capture": capture.name,
        **population(params["opacities"].sigmoid()),
    }
    pixels = [value for found in trained for value in found.get("theta_blur_pixels", ())]
    if pixels:
        stats["theta_blur_pixels"] = [min(pixels), max(pixels)]
    # as long as all blocks took in all rounds, one after the other
    counted = [*trained, *(row for found in before[1:] for row in found["blocks"]), *(rows if before else ())]
    seconds, total = (sum(found[name] for found in counted) for name in ("seconds", "seconds_total"))
    stats |= run_facts(config.backend, seconds, total)
    stats["seconds_loading"] = sum(found["seconds_loading"] for found in trained)
    results.write_stats("train", step, {**stats, "ellipse_time": seconds})
    stats |= _evaluated(config, capture, params, results)
    peak = max([peak_memory_bytes(), *(found["memory_bytes"] for found in counted)])
    rounds = [*before, _of_round(len(before), stats, params, rows)] if before else []
    return {
        **stats,
        "memory_bytes": peak,
        "mem": peak / 2**30,
        "memory_bytes_merging": peak_memory_bytes(),
        "blocks": list(first),
        **({"rounds": rounds} if rounds else {}),
    }


def _evaluated(
    config: TrainConfig, capture: Capture, params: dict[str, Tensor], results: ResultFolder | None = None
) -> dict[str, Any]:
    """Measure the held-out views; into a result folder go pictures of them, and then LPIPS is measured too."""
    step = config.max_steps - 1
    views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
    sizes = [(view.height, view.width) for view in views]
    nets = () if results is None else load_nets(config.lpips_vgg, config.lpips_alex, sizes)
    backend, _ = renderer(config.backend)
    degree = active_sh_degree(step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter)
    with reproducible(config.threads):
        return evaluate(backend, params, views, config, degree, nets, results, step)


def _results_stats(result: Path, step: int) -> dict[str, Any]:
    """Read the statistics of a block's last step, held-out views too; PopError where they are absent or damaged."""
    folder = ResultFolder(result)
    found = folder.read_stats("val", step)
    if found is None:
        raise PopError(f"{folder.stats_path('val', step)}: is absent; train the block again with --resume")
    return found


def _numbers(result: Path, step: int) -> dict[str, Any]:
    stats = _results_stats(result, step)
    names = ("num_GS", "psnr", "ssim", "seconds", "seconds_total", "memory_bytes")
    return {name: stats.get(name) for name in names}
