"""Results that no training made: for tests of what reads them, and written nowhere but into a test's own folder."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from paper_repro.results import BINS, Result

PLAIN = Result(
    scale="small",
    row="pop",
    scene="fox",
    seed=42,
    run="0123456789ab",
    commit="25d084e",
    config_hash="c" * 64,
    data_hash="d" * 64,
    machine="a machine",
    engine="native",
    threads=1,
    versions={"python": "3.11.0"},
    protocol={
        "split": "every 8th by name is held out",
        "test_views": 7,
        "images": "images",
        "factor": 4,
        "width": 270,
        "height": 480,
        "resize": "area",
        "ssim": "valid",
        "lpips": "no weights",
        "timing": "training loop",
        "checkpoint_bytes_per_gaussian": 236,
    },
    schedule={"max_steps": 10_000, "pop.blur_start_iter": 1000, "pop.blur_stop_iter": 2333},
    seconds={"load": 1.0, "train": 100.0, "evaluate": 2.0, "cpu": 100.0},
    num_gaussians=1000,
    checkpoint_mib=1000 * 236 / 2**20,
    psnr=30.0,
    ssim=0.9,
    lpips={"vgg_01": None, "alex_norm": None, "alex_01": None},
    lpips_reason="no weights were given (lpips_vgg, lpips_alex)",
    n_blended=20.0,
    n_traversed=100.0,
    opacity_below_01=0.25,
    opacity_above_09=0.5,
    opacity_histogram=(1000, *[0] * (BINS - 1)),
    curve=(),
    per_view={"a.png": {"psnr": 30.0, "ssim": 0.9}},
)


def result(row: str = "pop", scene: str = "fox", seed: int = 42, n: int = 1000, **changes: Any) -> Result:
    """Make a result; `n` sets everything that follows from the number of Gaussians, and the run id from the rest."""
    size = n * changes.get("protocol", PLAIN.protocol)["checkpoint_bytes_per_gaussian"] / 2**20
    run = hashlib.sha256(f"{row} {scene} {seed} {n}".encode()).hexdigest()[:12]
    told = {"run": run, "checkpoint_mib": size, "opacity_histogram": (n, *[0] * (BINS - 1)), **changes}
    return replace(PLAIN, row=row, scene=scene, seed=seed, num_gaussians=n, **told)


def curve(counts: Mapping[int, int], **more: Sequence[float | None]) -> tuple[Mapping[str, Any], ...]:
    """Make a curve from the number of Gaussians by step, and other columns in the same order."""
    columns = {name: list(values) for name, values in more.items()}
    return tuple(
        {"step": step, "num_gaussians": n, **{name: values[i] for name, values in columns.items()}}
        for i, (step, n) in enumerate(counts.items())
    )
