"""Four small photographs, and a schedule of 300 steps in which everything happens that a training knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pop_fast.data.capture import Capture, View
from pop_ref.settings import DensityConfig, LearningRates, Recipe
from tests.app.tiny import look_at

WIDTH, HEIGHT, N_POINTS, STEPS = 18, 12, 14, 300

DENSITY = DensityConfig(
    grow_grad2d=0.012,
    grow_scale3d=0.12,
    prune_opa=0.06,
    prune_scale3d=0.26,
    prune_too_big=True,
    prune_too_big_after=60,
    refine_start_iter=10,
    refine_stop_iter=260,
    refine_every=12,
    theta_blur=0.05,
    blur_start_iter=96,
    blur_stop_iter=180,
    reset_every=70,
    reset_opa=0.2,
)
RECIPE = Recipe(
    density=DENSITY,
    lr=LearningRates(means=4e-3, scales=2e-2, quats=4e-3, opacities=5e-2, sh0=3e-2, sh_rest=2e-3),
    lambda_pop=5e-3,
    pop_start_iter=20,
    pop_stop_iter=220,
    l2_stop_iter=256,
    max_steps=STEPS,
    sh_interval=40,
)
# the same in ten steps
SHORT = replace(
    RECIPE,
    density=replace(
        DENSITY,
        grow_grad2d=0.0025,
        refine_start_iter=1,
        refine_stop_iter=9,
        refine_every=3,
        blur_start_iter=5,
        blur_stop_iter=7,
        reset_every=4,
    ),
    pop_start_iter=1,
    pop_stop_iter=8,
    l2_stop_iter=9,
    max_steps=10,
    sh_interval=3,
)


def capture() -> Capture:
    """Return discs of coloured points, far to near, from a quarter of a ring."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (N_POINTS, 3))
    colors = rng.integers(30, 255, (N_POINTS, 3), dtype=np.uint8)
    K = np.array([[19.5, 0.0, WIDTH / 2], [0.0, 19.5, HEIGHT / 2], [0.0, 0.0, 1.0]])
    xs, ys = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    views = []
    for i, angle in enumerate((-0.6, -0.2, 0.2, 0.6)):
        viewmat = look_at(np.array([4.0 * np.sin(angle), 0.4, -4.0 * np.cos(angle)]))
        cam = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        image = np.full((HEIGHT, WIDTH, 3), (8 * (xs + ys))[..., None] % 97, dtype=np.uint8)
        for j in np.argsort(-cam[:, 2]):
            u, v = (K @ cam[j])[:2] / cam[j, 2]
            image[(xs - u) ** 2 + (ys - v) ** 2 < (9.0 / cam[j, 2]) ** 2] = colors[j]
        views.append(View(f"{i}.png", image, viewmat, K, seen=np.arange(i % 2, N_POINTS, 2, dtype=np.int32)))
    return Capture("steps", tuple(views), points, colors, source="made up")
