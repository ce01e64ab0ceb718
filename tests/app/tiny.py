"""A capture that trains in seconds: five 32 x 24 views of coloured points on a ring, and settings to match.

Run as a script it trains, for tests that have to stop a process: `python tests/app/tiny.py FOLDER [resume]`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pop_fast.data.capture import Capture, View
from pop_fast.density import GsplatStrategy, InriaStrategy, POPStrategy
from pop_fast.train import LearningRates, TrainConfig, TrainingRun
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.results import Segment

WIDTH, HEIGHT = 32, 24
N_POINTS = 60


def look_at(position: np.ndarray) -> np.ndarray:
    """World -> camera at `position`, looking at the origin, y down."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(np.array([0.0, 1.0, 0.0]), forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return np.block([[R, -R @ position[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])


def tiny_capture(seed: int = 0, n_views: int = 5, mask: np.ndarray | None = None) -> Capture:
    """Photographs are discs of the points' colours, drawn far to near: something that splats can fit."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (N_POINTS, 3))
    colors = rng.integers(40, 255, (N_POINTS, 3), dtype=np.uint8)
    K = np.array([[30.0, 0.0, WIDTH / 2], [0.0, 30.0, HEIGHT / 2], [0.0, 0.0, 1.0]])
    xs, ys = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    views = []
    for i in range(n_views):
        angle = 2.0 * np.pi * i / n_views
        viewmat = look_at(np.array([4.0 * np.sin(angle), 0.5, 4.0 * np.cos(angle)]))
        cam = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        image = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        for j in np.argsort(-cam[:, 2]):
            u, v = (K @ cam[j])[:2] / cam[j, 2]
            image[(xs - u) ** 2 + (ys - v) ** 2 < (8.0 / cam[j, 2]) ** 2] = colors[j]
        views.append(View(f"{i:02d}.png", image, viewmat, K, mask, seen=np.arange(i % 3, N_POINTS, 3)))
    return Capture("tiny", tuple(views), points, colors, source="made up")


def last_checkpoint(folder: Path, *without: str) -> dict[str, Any]:
    """Return what a finished run of `tiny_config` keeps last, but for some of its parts, by dotted name."""
    content, flat = ckpt.load_checkpoint(ckpt.checkpoint_path(folder, 29)), {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, item in value.items():
                walk(item, f"{name}.{key}")
        else:
            flat[name] = value

    walk({key: value for key, value in content.items() if key not in without}, "")
    return flat


def tiny_config(folder: Path | str, method: str = "pop", **changes: Any) -> TrainConfig:
    """Thirty steps, at high rates, with all density control: growth, blur, pruning, resets, all colour bands."""
    steps = {
        "refine_start_iter": 3,
        "refine_stop_iter": 24,
        "refine_every": 4,
        "prune_too_big": True,
        "prune_too_big_after": 8,
    }
    grow = {"grow_grad2d": 3e-3, "grow_scale3d": 0.05}
    strategies = {
        "pop": POPStrategy(**steps, **grow, blur_start_iter=8, blur_stop_iter=16, theta_blur=0.02, pop_stop_iter=24),
        "gsplat": GsplatStrategy(**steps, **grow, reset_every=12),
        "3dgs": InriaStrategy(**steps, **grow, reset_every=12),
    }
    base = replace(
        TrainConfig.of(method=method),
        given=None,
        strategy=strategies[method],
        result_dir=str(folder),
        max_steps=30,
        seed=7,
        backend="fast",
        test_every=5,
        sh_interval=6,
        init_opacity=0.5,
        init_scale=0.5,
        lr=LearningRates(means=4e-3, scales=5e-2, opacities=0.1, sh0=0.1, sh_rest=5e-3),
        threads=1,
        eval_steps=(12,),
        save_steps=(12,),
        checkpoint_every=5,
        log_every=2,
        progress=False,
    )
    return replace(base, **changes)


class SlowRun(TrainingRun):
    """Leaves time to be stopped in."""

    def take_steps(self, last: int) -> Segment:
        """Take a step, and a breath."""
        time.sleep(0.02)
        return super().take_steps(last)


if __name__ == "__main__":
    SlowRun(tiny_config(sys.argv[1]), tiny_capture(), resume=sys.argv[2:] == ["resume"]).run()
