"""The folder that a run writes, laid out as gsplat's trainer does.

    cfg.json                        the settings, before `steps_scaler`
    metrics.jsonl                   one record every `log_every` steps and at every change of the population
    ckpts/ckpt_{step}_rank0.pt      checkpoints; `step` counts from 0 here and below, so 30,000 steps end at 29999
    ply/point_cloud_{step}.ply      Gaussians in Inria's layout
    stats/train_step{step}.json     Gaussians, opacities, seconds, memory, machine, versions
    stats/val_step{step}.json       the same and PSNR, SSIM, LPIPS of the held-out views, and each view's own
    renders/val_step{step}_{i}.png        render | photograph | error
    renders/dominant_step{step}_{i}.png   every pixel in the colour of its dominant Gaussian
    report_data/opacity_step{step}.npz    counts [100] of opacities in equal bins of [0, 1]; step -1 is the start
    report_data/val_step{step}_{i}.npz    name, render, photo (uint8 [H, W, 3]), dominant_ids (int32 [H, W]), psnr, ssim

A record of metrics.jsonl holds: step, view, loss, l1 or l2 (the pixel-wise term), d_ssim, pop (weighted, absent when
off), psnr (of the training view), num_gaussians, n_blended and n_traversed (per pixel; not in runs on a GPU),
sh_degree, lr_means, it_per_s, seconds (training alone); after a change of the population also cloned, split, pruned,
and reset when opacities were. Statistics of runs on a GPU also hold gpu, gpu_memory_bytes and instance_buffers_grown.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.errors import PopError
from pop_fast.io.atomic import write_atomically
from pop_fast.train.config import TrainConfig

_OURS = ("cfg.json", "metrics.jsonl", "ckpts", "ply", "stats", "renders", "report_data", "report.html", "capture.json")
OPACITY_BINS = 100


class ResultFolder:
    """A run's folder; every file but metrics.jsonl is written whole or not at all."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._metrics: Any = None

    def claim(self, resume: bool, overwrite: bool) -> None:
        """Make the folder this run's own: new, emptied of results, or left as it is to go on with.

        Raises:
            PopError: the folder is in use and neither `resume` nor `overwrite` is set, or it is not a result folder.
        """
        if self.path.exists() and not self.path.is_dir():
            raise PopError(f"{self.path}: is a file; choose another result folder")
        used = self.path.is_dir() and any(self.path.iterdir())
        if used and not resume and not overwrite:
            raise PopError(f"{self.path}: exists and is not empty; pass --resume, --overwrite or another result folder")
        if used and not (self.path / "cfg.json").is_file():
            raise PopError(f"{self.path}: has no cfg.json, so it is not a result folder; choose another")
        if overwrite and not resume:
            self._remove_results()

    def write_config(self, config: TrainConfig) -> None:
        """Write cfg.json."""
        write_atomically(self.path / "cfg.json", lambda file: file.write(config.to_json().encode()))

    def _remove_results(self) -> None:
        for name in _OURS:
            target = self.path / name
            if target.is_dir():
                shutil.rmtree(target)
            else:
                target.unlink(missing_ok=True)

    def open_metrics(self, keep_bytes: int) -> None:
        """Open metrics.jsonl to append, cut to what a checkpoint vouches for."""
        path = self.path / "metrics.jsonl"
        path.touch()
        have = path.stat().st_size
        if have < keep_bytes:
            raise PopError(f"{path}: has {have} bytes, fewer than the {keep_bytes} of the checkpoint; restore the file")
        # unbuffered: whoever watches the file sees a record when it is made
        self._metrics = open(path, "r+b", buffering=0)  # noqa: SIM115 - stays open as long as the run
        self._metrics.truncate(keep_bytes)
        self._metrics.seek(keep_bytes)

    def log(self, record: dict[str, Any]) -> None:
        """Append a record."""
        self._metrics.write((json.dumps(record) + "\n").encode())

    def flush_metrics(self) -> int:
        """Hand all records to the operating system and return the length of the file."""
        self._metrics.flush()
        return self._metrics.tell()

    def close(self) -> None:
        """Close metrics.jsonl."""
        if self._metrics is not None:
            self._metrics.close()
            self._metrics = None

    def write_stats(self, kind: str, step: int, stats: dict[str, Any]) -> None:
        """Write stats/{kind}_step{step}.json."""
        text = json.dumps(_finite(stats), indent=2) + "\n"
        write_atomically(self.stats_path(kind, step), lambda file: file.write(text.encode()))

    def read_stats(self, kind: str, step: int) -> dict[str, Any] | None:
        """Read what `write_stats` wrote, or None."""
        path = self.stats_path(kind, step)
        return json.loads(path.read_text()) if path.is_file() else None

    def stats_path(self, kind: str, step: int) -> Path:
        """Return the name of a stats file."""
        return self.path / "stats" / f"{kind}_step{step:04d}.json"

    def write_arrays(self, stem: str, **arrays: Any) -> None:
        """Write report_data/{stem}.npz."""
        write_atomically(self.path / "report_data" / f"{stem}.npz", lambda file: np.savez_compressed(file, **arrays))

    def write_opacities(self, step: int, opacities: np.ndarray) -> None:
        """Write the histogram of opacities after a step; -1 for before the first."""
        counts, edges = np.histogram(opacities, bins=OPACITY_BINS, range=(0.0, 1.0))
        self.write_arrays(f"opacity_step{step}", step=step, counts=counts, edges=edges)


def _finite(value: Any) -> Any:
    """Replace what JSON cannot hold: NaN and infinities become null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
