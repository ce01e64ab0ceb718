"""A small result folder as `pop train` leaves it, made without training."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.train.config import TrainConfig

VIEWS = ("a.png", "b.png")


def write_result(folder: Path, method: str = "pop", steps: int = 300, **stats: Any) -> Path:
    """Write cfg.json, metrics.jsonl, stats and report_data of a made-up run of `steps` steps; returns the folder."""
    config = TrainConfig.of(data="captures/toy", method=method, steps_scaler=steps / 30_000)
    for name in ("stats", "report_data"):
        (folder / name).mkdir(parents=True)
    (folder / "cfg.json").write_text(config.to_json())
    rng = np.random.default_rng(0)
    with open(folder / "metrics.jsonl", "w") as file:
        for step in range(0, steps, 10):
            file.write(json.dumps(_record(step, steps, rng)) + "\n")
    measured = {"psnr": 24.5, "ssim": 0.81, "lpips": None, "lpips_reason": "no weights were given", **stats}
    last = steps - 1
    base = {"step": last, "num_GS": 1200, "num_GS_above_floor": 1100, "seconds": 30.0, "machine": "a machine"}
    opacity = {"opacity_below_0.1": 0.25, "opacity_above_0.9": 0.5}
    (folder / "stats" / f"train_step{last:04d}.json").write_text(json.dumps({**base, **opacity}))
    (folder / "stats" / f"val_step{last:04d}.json").write_text(json.dumps({**base, **opacity, **measured}))
    edges = np.linspace(0.0, 1.0, 101)
    for step, sample in ((-1, np.full(50, 0.1)), (69, rng.beta(1, 1, 500)), (last, rng.beta(0.3, 0.3, 500))):
        counts = np.histogram(sample, edges)[0]
        np.savez(folder / "report_data" / f"opacity_step{step}.npz", step=step, counts=counts, edges=edges)
    for i, name in enumerate(VIEWS):
        photo = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
        render = np.clip(photo.astype(int) + rng.integers(-9, 9, photo.shape), 0, 255).astype(np.uint8)
        ids = rng.integers(-1, 40, (24, 32)).astype(np.int32)
        arrays = {"name": name, "render": render, "photo": photo, "dominant_ids": ids, "psnr": 24.0 + i, "ssim": 0.8}
        np.savez(folder / "report_data" / f"val_step{last}_{i}.npz", **arrays)
    return folder


def _record(step: int, steps: int, rng: np.random.Generator) -> dict[str, Any]:
    record: dict[str, Any] = {
        "step": step,
        "loss": 0.1 / (1 + step / 50) + 0.001 * float(rng.random()),
        "psnr": 15.0 + 10.0 * step / steps,
        "num_gaussians": 1000 + step,
        "n_blended": 20.0 - step / steps,
        "n_traversed": 40.0 - step / steps,
    }
    if step in (20, 40):
        record |= {"cloned": 5, "split": 3, "pruned": 2}
    if step == 40:
        record["reset"] = True
    return record
