"""A capture that trains in seconds, five 32 x 24 views of coloured points on a ring, and ways to cut such a run short.

Run as a script it trains, for tests that have to stop a process: `python tests/app/tiny.py FOLDER [resume]`.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.api.backend import get_backend
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


def skip_without(backend: str) -> None:
    reason = get_backend(backend).why_not()
    if reason is not None:
        pytest.skip(reason)


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


def records(folder: Path, *without: str) -> list[dict[str, Any]]:
    """Return the lines of metrics.jsonl, but for some of their entries."""
    lines = map(json.loads, (folder / "metrics.jsonl").read_text().splitlines())
    return [{key: value for key, value in line.items() if key not in without} for line in lines]


def assert_same_run(folder: Path, reference: Path, *without: str) -> None:
    """Compare all that two finished runs leave and that depends on no clock, but for some parts of the checkpoint."""
    ours, theirs = (last_checkpoint(each, "seconds", "metrics_bytes", *without) for each in (folder, reference))
    assert list(ours) == list(theirs)
    assert {"splats", "optimizers", "strategy", "view_order"} <= {name.split(".")[1] for name in ours}
    for name, value in ours.items():
        if isinstance(value, torch.Tensor):
            assert value.dtype == theirs[name].dtype, name
            assert torch.equal(value, theirs[name]), name
        else:
            assert value == theirs[name], name
    assert records(folder, "it_per_s", "seconds") == records(reference, "it_per_s", "seconds")


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


_TAKE_STEPS = TrainingRun.take_steps


class Killed(BaseException):
    """The process is gone: from here on nothing that it tries has an effect."""


def interrupt(monkeypatch: pytest.MonkeyPatch, at: int) -> None:
    """Let every run be left at once, without a checkpoint, when it has taken `at` steps."""

    def stepping(training: TrainingRun, last: int) -> Any:
        if training.step == at:
            raise KeyboardInterrupt
        # an engine that takes many steps at a time is stopped there too
        return _TAKE_STEPS(training, min(last, at) if training.step < at else last)

    monkeypatch.setattr(TrainingRun, "take_steps", stepping)


@contextmanager
def interrupted(at: int) -> Iterator[None]:
    """Let the run in this block be left at once, without a checkpoint, when it has taken `at` steps."""
    with pytest.MonkeyPatch.context() as patch:
        interrupt(patch, at)
        with pytest.raises(KeyboardInterrupt):
            yield


def run_until(training: TrainingRun, at: int | None = None) -> None:
    """Run to the end, or leave at once, without a checkpoint, when `at` steps are taken."""
    if at is None:
        training.run()
        return
    with interrupted(at):
        training.run()


@contextmanager
def killed_after(changes: int) -> Iterator[None]:
    """Let the first so many renames, removals and new folders happen and raise `Killed` at each one after them."""
    left = changes

    def counted(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            nonlocal left
            if left == 0:
                raise Killed
            left -= 1
            return function(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in ((os, "replace"), (Path, "mkdir"), (Path, "unlink"), (Path, "rmdir"), (shutil, "rmtree")):
            patch.setattr(owner, name, counted(getattr(owner, name)))
        yield


if __name__ == "__main__":
    SlowRun(tiny_config(sys.argv[1]), tiny_capture(), resume=sys.argv[2:] == ["resume"]).run()
