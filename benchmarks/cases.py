"""The scenes that are timed, made from a seed, and times of calls that take turns, so that noise is alike for each."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pop_fast.data.capture import Capture, View

VIEWS = 6  # of a capture


@dataclass(frozen=True)
class Case:
    """A synthetic scene."""

    name: str  # as it stands in results
    n: int  # Gaussians
    width: int  # px
    height: int  # px
    spread: float = 1.0  # factor on the Gaussians' size; 1 covers a pixel with about fifteen


RASTER_CASES = (
    Case("270x480-12k", 12_000, 270, 480),
    Case("270x480-40k", 40_000, 270, 480),
    Case("640x480-100k", 100_000, 640, 480),
)
MEMORY_CASE = Case("1600x1000-300k", 300_000, 1600, 1000)
STEP_CASES = (*RASTER_CASES, MEMORY_CASE)
GATE_CASE = Case("gate", 40, 37, 29, 6.0)


def gaussians_of(case: Case, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Draw a scene: centres fill the frustum, sizes are log-normal and shrink as the scene gets denser.

    Returns:
        The arguments of `rasterization`, third-degree harmonics as colours.
    """
    rng = np.random.default_rng(0)
    focal = 0.9 * max(case.width, case.height)
    z = rng.uniform(2.0, 6.0, case.n)
    x = rng.uniform(-0.6, 0.6, case.n) * case.width / focal * z
    y = rng.uniform(-0.6, 0.6, case.n) * case.height / focal * z
    pixels = 0.0069 * case.spread * np.sqrt(12_000 / case.n) * np.sqrt(case.width * case.height / 129_600)
    scales = np.exp(rng.normal(0.0, 0.6, (case.n, 3))) * (pixels * 312.0 * z / focal)[:, None]
    given = {
        "means": np.stack((x, y, z), 1),
        "quats": rng.normal(size=(case.n, 4)),
        "scales": scales,
        "opacities": 1.0 / (1.0 + np.exp(-2.5 * rng.normal(size=case.n))),
        "colors": 0.2 * rng.normal(size=(case.n, 16, 3)),
        "viewmats": np.eye(4)[None],
        "Ks": np.array([[[focal, 0.0, 0.5 * case.width], [0.0, focal, 0.5 * case.height], [0.0, 0.0, 1.0]]]),
    }
    return {name: torch.tensor(value, dtype=dtype) for name, value in given.items()}


def capture_of(case: Case) -> Capture:
    """Make a capture whose sparse points start training with `case.n` Gaussians; its photographs are smooth noise."""
    rng = np.random.default_rng(0)
    scene = gaussians_of(case, torch.float64)
    K = scene["Ks"][0].numpy()
    made: list[View] = []
    for i in range(VIEWS):
        coarse = torch.tensor(rng.uniform(0.0, 255.0, (1, 3, case.height // 16 + 2, case.width // 16 + 2)))
        smooth = torch.nn.functional.interpolate(coarse, (case.height, case.width), mode="bicubic").clamp(0.0, 255.0)
        viewmat = np.eye(4)
        viewmat[:3, 3] = rng.uniform(-0.05, 0.05, 3)
        made.append(View(f"{i:03d}.png", smooth[0].permute(1, 2, 0).to(torch.uint8).numpy(), viewmat, K))
    colours = rng.integers(0, 256, (case.n, 3)).astype(np.uint8)
    return Capture(case.name, tuple(made), scene["means"].numpy(), colours, "made from a seed")


def turns(runs: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 3) -> dict[str, list[float]]:
    """Run each call once a turn, in changing order, and time it.

    Args:
        runs: calls by name.
        repeats: turns that count.
        warm_up: turns before that.

    Returns:
        The seconds of each, turn by turn.
    """
    names = list(runs)
    taken: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(warm_up + repeats):
        for name in names if turn % 2 else reversed(names):
            start = time.perf_counter()
            runs[name]()
            seconds = time.perf_counter() - start
            if turn >= warm_up:
                taken[name].append(seconds)
    return taken


def turns_ms(runs: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Time calls in turns as `turns` does; the first is what the others are compared with.

    Returns:
        The median of each, ms, and as "b / a" the median of the ratios within a turn.
    """
    names, taken = list(runs), turns(runs, repeats)
    found = {name: 1e3 * statistics.median(times) for name, times in taken.items()}
    for name in names[1:]:
        found[f"{name} / {names[0]}"] = median_ratio(taken[name], taken[names[0]])
    return found


def median_ratio(mine: Sequence[float], its: Sequence[float]) -> float:
    """Return the median of the ratios within a turn."""
    return statistics.median(a / b for a, b in zip(mine, its, strict=True))
