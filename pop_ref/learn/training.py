"""Train a small scene with the student's own code: every stage theirs, the loop around them the oracle's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pop_ref.learn.course import COURSE
from pop_ref.learn.splat import l2, orbit, photograph, start
from pop_ref.learn.student import Work, borrowing, said, where


@dataclass(frozen=True)
class Told:
    """A training on its way: the step, its loss, the Gaussians, a photograph and its render side by side."""

    step: int
    loss: float
    psnr: float
    n: int
    picture: np.ndarray


def train(work: Work, steps: int = 60, size: int = 24, n: int = 100, every: int = 10, seed: int = 0) -> Iterator[Told]:
    """Fit the toy, telling now and then.

    Raises:
        ValueError: a stage is not written, or stops with an error; the message names it.
    """
    missing = [stage.name for stage in COURSE if not work.is_whole(stage)]
    if missing:
        raise ValueError(f"not all is written yet: {', '.join(missing)}; 'pop-learn check' says what each lacks")
    with borrowing(work) as borrowed:
        try:
            yield from _steps(borrowed, steps, size, n, every, np.random.default_rng(seed))
        except Exception as error:
            at = where(error, work.folder)
            if at == str(work.folder):
                raise
            raise ValueError(
                f"{at}: it stops with {said(error)}; 'pop-learn check {Path(at.split(',')[0]).stem}'"
            ) from None


def _steps(borrowed, steps: int, size: int, n: int, every: int, rng: np.random.Generator) -> Iterator[Told]:
    training, types, recipes = (borrowed.module(name) for name in ("training", "records", "recipes"))
    recipe = recipes.RECIPES["POP"]
    rates = replace(recipe.lr, means=4e-3, quats=1e-2, scales=2e-2, opacities=5e-2, sh0=3e-2)
    density = replace(recipe.density, refine_start_iter=0, refine_every=max(2, steps // 3), refine_stop_iter=steps)
    recipe = replace(recipe, max_steps=steps, lr=rates, density=density, lambda_ssim=0.0)
    cameras = [orbit(2 * np.pi * k / 6, size) for k in range(6)]
    photographs = [photograph(camera) for camera in cameras]
    target = photographs[0]
    state = training.start(start(n, rng))
    for step in range(steps):
        k = int(rng.integers(len(cameras)))
        state, loss = training.train_step(
            state, types.Camera(*cameras[k]), photographs[k], 1.0, lambda n: rng.standard_normal((2, n, 3)), recipe
        )
        if (step + 1) % every == 0 or step == steps - 1:
            gaussians = training.gaussians_from_params(state.rows.params)
            image = borrowed.module("render").render(gaussians, types.Camera(*cameras[0])).image
            psnr = -10.0 * np.log10(l2(np.clip(image, 0.0, 1.0), target)[0])
            yield Told(step + 1, loss, float(psnr), len(gaussians), np.concatenate([target, image], axis=1))
