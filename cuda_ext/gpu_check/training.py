"""Trainings on a GPU node as `pop train` does them: how they are begun, and what is kept of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from cuda_ext.gpu_check.shared import StageContext, read_json, skipped

TRAIN = "from pop_fast.cli import main; raise SystemExit(main())"
# what a training run is judged by
_KEPT = ("step", "seconds", "seconds_loading", "seconds_total", "num_GS", "num_GS_above_floor", "psnr", "ssim", "views")
_KEPT += ("gpu", "gpu_memory_bytes", "instance_buffers_grown", "photograph_bytes", "photographs_passing")
_KEPT += ("received_bytes",)


def captures_of(check: StageContext) -> list[Path]:
    """List what was brought along to train on, and what was given."""
    packed = sorted((check.packed / "captures").glob("*/")) if check.packed else []
    return [*packed, *check.captures]


def no_capture() -> dict[str, Any]:
    """Return what a stage found that has nothing to train on."""
    return skipped("no captures were given (--captures DIR ...) or brought along")


def last_stats(folder: Path) -> dict[str, Any] | None:
    """Return what is kept of the last measurement of a run; `seconds_training` is its `seconds`."""
    stats = sorted((folder / "stats").glob("val_step*.json"), key=lambda file: int(file.stem.split("step")[1]))
    if not stats:
        return None
    last = read_json(stats[-1])
    return {**{name: last.get(name) for name in _KEPT}, "seconds_training": last.get("seconds")}


def train_stage(check: StageContext) -> dict[str, Any]:
    """Train POP on every capture as `pop train --backend cuda` does; seconds, Gaussians, PSNR, SSIM."""
    captures = captures_of(check)
    if not captures:
        return no_capture()
    if importlib.util.find_spec("tyro") is None and not (check.site / "tyro").is_dir():
        return skipped(
            "`pop train` needs tyro, which is neither installed nor among the wheels that were brought along"
        )
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "runs": {}}
    for k, path in enumerate(captures):
        one = train_one(check, path, (check.seconds - found["seconds"]) / (len(captures) - k))
        found["runs"][path.name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def train_one(check: StageContext, path: Path, limit: float, backend: str = "cuda") -> dict[str, Any]:
    """Train on one capture, or continue with the training of an earlier call at the same commit."""
    folder = check.work / f"{path.name}_{backend}_{check.steps_scaler:g}_{check.commit[:12]}"
    words = ["train", str(path), "--out", str(folder), "--backend", backend]
    words += ["--steps-scaler", str(check.steps_scaler), "--no-progress", "--max-renders", "1"]
    words += ["--skip-sizes", "--skip-checks"]
    words += ["--resume"] if (folder / "cfg.json").exists() else []
    found = check.run(check.python("-c", TRAIN, *words), limit)
    told = last_stats(folder)
    if found["status"] == 130:
        found |= {"status": 124, "note": "the time was up; where the folder survives, the next call continues"}
    elif found["status"] == 0 and told is None:
        found["status"] = 1
    return {**(told or {}), **found}
