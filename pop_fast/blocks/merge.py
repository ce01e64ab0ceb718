"""Put trained blocks together: of each the Gaussians whose centre lies in its core, and of no other."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from pop_fast.blocks.partition import Partition
from pop_fast.blocks.plan import FOLDER, read_plan
from pop_fast.data.capture import Capture
from pop_fast.errors import PopError
from pop_fast.io.ply import Frame, save_ply
from pop_fast.train.checkpoint import checkpoint_path, save_checkpoint
from pop_fast.train.config import TrainConfig
from pop_fast.train.environment import peak_memory_bytes, reproducible, run_facts
from pop_fast.train.evaluate import evaluate
from pop_fast.train.gpu_proxy import renderer
from pop_fast.train.load_result import load_splat
from pop_fast.train.lpips import load_nets
from pop_fast.train.metrics import population
from pop_fast.train.model import KEYS
from pop_fast.train.results import ResultFolder
from pop_fast.train.schedule import active_sh_degree
from pop_fast.train.views import ViewTensors

__all__ = ["kept_of", "merge", "result_of"]

# what a block's statistics say of the settings, which are those of all
_SETTINGS: Final = ("method", "preset", "seed", "lambda_pop", "blur_min_pixels", "blur_events", "stepper")


def result_of(folder: Path, name: str) -> Path:
    """Return the result folder of a block of the run in `folder`."""
    return folder / FOLDER / name / "result"


def kept_of(partition: Partition, number: int, params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the rows of a block's Gaussians whose centre lies in its core.

    Every centre lies in one core, so that what different blocks keep never overlaps.

    Args:
        partition: the cores.
        number: the block's.
        params: its raw parameters.
    """
    kept = torch.from_numpy(partition.block_of(params["means"].double().numpy()) == number)
    return {key: value[kept] for key, value in params.items()}


def merge(folder: Path, config: TrainConfig, capture: Capture) -> dict[str, Any]:
    """Merge the trained blocks of a run: write checkpoint, PLY, pictures and statistics, as a training does at its end.

    One block is in memory at a time, and of the capture the held-out photographs.

    Args:
        folder: the run's.
        config: its settings.
        capture: the whole, of which the held-out photographs have been read.

    Returns:
        The statistics, as in stats/val_step{step}.json; `blocks` has each block's own.

    Raises:
        PopError: the capture is not divided, or a block is not trained to its end.
    """
    start, step = time.perf_counter(), config.max_steps - 1
    plan = read_plan(folder)
    if plan is None:
        raise PopError(f"{folder}: its capture is not divided yet; run pop blocks partition {folder}")
    partition, entries = plan
    parts: list[dict[str, Tensor]] = []
    rows: list[dict[str, Any]] = []
    for number, entry in enumerate(entries):
        result = result_of(folder, entry["name"])
        splat = load_splat(result)
        if splat.step != step:
            raise PopError(f"{result}: is not trained to its end; run pop blocks train {folder} {entry['name']}")
        parts.append(kept_of(partition, number, splat.params))
        rows.append({**entry, "kept": len(parts[-1]["means"]), **_numbers(result, step)})
    params = {key: torch.cat([part[key] for part in parts]) for key in KEYS}
    parts.clear()
    if len(params["means"]) == 0:
        raise PopError(f"{folder}: no block has a Gaussian in its core, so that nothing is left; look at the blocks")
    results = ResultFolder(folder)
    results.hold()
    try:
        _write_splat(results, config, capture, params)
        stats = _measured(results, config, capture, params, rows)
    finally:
        results.close()
    stats["seconds_merging"] = time.perf_counter() - start
    results.write_stats("val", step, stats)
    return stats


def _write_splat(results: ResultFolder, config: TrainConfig, capture: Capture, params: dict[str, Tensor]) -> None:
    step = config.max_steps - 1
    frame = Frame.of_training(capture.world_transform if config.normalize else None)
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
) -> dict[str, Any]:
    step = config.max_steps - 1
    views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
    nets = load_nets(config.lpips_vgg, config.lpips_alex, [(view.height, view.width) for view in views])
    trained = [results_stats(result_of(results.path, row["name"]), step) for row in rows]
    stats: dict[str, Any] = {
        "step": step,
        **{name: trained[0][name] for name in _SETTINGS if name in trained[0]},
        "capture": capture.name,
        **population(params["opacities"].sigmoid()),
    }
    pixels = [value for found in trained for value in found.get("theta_blur_pixels", ())]
    if pixels:
        stats["theta_blur_pixels"] = [min(pixels), max(pixels)]
    # as long as all blocks took, one after the other
    seconds, total = (sum(found[name] for found in trained) for name in ("seconds", "seconds_total"))
    stats |= run_facts(config.backend, seconds, total)
    stats["seconds_loading"] = sum(found["seconds_loading"] for found in trained)
    results.write_stats("train", step, {**stats, "ellipse_time": seconds})
    backend, _ = renderer(config.backend)
    degree = active_sh_degree(step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter)
    with reproducible(config.threads):
        stats |= evaluate(backend, params, views, config, degree, nets, results, step)
    peak = max([peak_memory_bytes(), *(found["memory_bytes"] for found in trained)])
    return {
        **stats,
        "memory_bytes": peak,
        "mem": peak / 2**30,
        "memory_bytes_merging": peak_memory_bytes(),
        "blocks": rows,
    }


def results_stats(result: Path, step: int) -> dict[str, Any]:
    """Read the statistics of a block's last step: the training's, and the held-out views' where there are some.

    Raises:
        PopError: they are absent or damaged.
    """
    folder = ResultFolder(result)
    found = folder.read_stats("val", step)
    if found is None:
        raise PopError(f"{folder.stats_path('val', step)}: is absent; train the block again with --resume")
    return found


def _numbers(result: Path, step: int) -> dict[str, Any]:
    stats = results_stats(result, step)
    names = ("num_GS", "psnr", "ssim", "seconds", "seconds_total", "memory_bytes")
    return {name: stats.get(name) for name in names}
