"""Ten steps of training on three 16 x 16 views, and the ladder of their losses, fixed for good.

The photographs are formulas, not renders, and the schedule is squeezed so that ten steps pass through everything: the
harmonics gain a band, two densification steps clone, split, prune and use the blur rule, the POP term starts and ends.
Run as a module, this prints the rungs as they stand in `WRITTEN`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pop_ref.density import POP
from pop_ref.recipes import RECIPES, Recipe
from pop_ref.records import Camera
from pop_ref.training import start, train_step

SIZE = 16
SCENE_SCALE = 2.0
STEPS = 10

RECIPE: Recipe = replace(
    RECIPES["POP"],
    density=replace(
        POP,
        grow_grad2d=0.008,
        grow_scale3d=0.2,
        prune_scale3d=0.3,
        prune_too_big=True,
        prune_too_big_after=5,
        prune_opa=0.02,
        refine_start_iter=1,
        refine_stop_iter=9,
        refine_every=3,
        theta_blur=0.25,
        blur_start_iter=5,
        blur_stop_iter=7,
    ),
    pop_start_iter=1,
    pop_stop_iter=8,
    sh_interval=4,
    max_steps=STEPS,
)


class Rung(NamedTuple):
    """The loss of a step, and how many Gaussians there are after it."""

    loss: float
    n: int


# the ladder that the oracle climbed when it was written down
WRITTEN = (
    Rung(0.08884678424699882, 10),
    Rung(0.09285824848056604, 10),
    Rung(0.09794700504730512, 10),
    Rung(0.08719937066071075, 12),
    Rung(0.0945107291015662, 12),
    Rung(0.09743318533813945, 12),
    Rung(0.0929286709468561, 16),
    Rung(0.09818222650834028, 16),
    Rung(0.09619817304875346, 16),
    Rung(0.10064481524508341, 16),
)


def cameras() -> list[Camera]:
    """Return three views of the origin from a distance of 4, turned by -1/4, 0 and 1/4 rad about the vertical."""
    K = np.array([[18.0, 0.0, 7.75], [0.0, 18.0, 8.5], [0.0, 0.0, 1.0]])
    views = []
    for angle in (-0.25, 0.0, 0.25):
        c, s = np.cos(angle), np.sin(angle)
        viewmat = np.array([[c, 0.0, s, 0.0], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 4.0], [0.0, 0.0, 0.0, 1.0]])
        views.append(Camera(viewmat, K, SIZE, SIZE))
    return views


def photographs() -> list[np.ndarray]:
    """Return a disc on a ramp, moving sideways from view to view; multiples of 1/255, as bytes are."""
    x, y = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    photos = []
    for centre in (6.0, 8.0, 10.0):
        disc = ((x - centre) ** 2 + (y - 8.0) ** 2 < 20.0).astype(np.float64)
        photos.append(np.round(255.0 * np.stack([0.75 * disc, x / 32.0, 0.5 - 0.25 * disc], axis=2)) / 255.0)
    return photos


def first_params() -> dict[str, np.ndarray]:
    """Return ten Gaussians of three sizes, one of them nearly transparent and one far too large."""
    n = 10
    i = np.arange(1.0, n + 1.0)[:, None]

    def spread(width: int, seed: float) -> np.ndarray:
        # multiples of an irrational number, modulo 1, fill the interval evenly and are the same everywhere
        return (i * (np.sqrt(2.0) * np.arange(1, width + 1) + seed)) % 1.0

    opacities = 4.0 * spread(1, 0.5)[:, 0] - 1.5
    opacities[3] = -4.5
    log_scales = np.log(np.array([0.125, 0.25, 0.5]))[np.arange(n) % 3][:, None] + 0.25 * spread(3, 0.25)
    log_scales[7, 1] = np.log(0.75)
    return {
        "means": 2.0 * spread(3, 0.0) - 1.0,
        "scales": log_scales,
        "quats": spread(4, 0.125) - 0.5,
        "opacities": opacities,
        "sh0": 2.0 * spread(3, 0.375)[:, None, :] - 1.0,
        "shN": 0.5 * spread(9, 0.625).reshape(n, 3, 3) - 0.25,
    }


def draws(n: int) -> np.ndarray:
    """Return two draws for each of n split parents, [2, n, 3]: a fixed sequence in the place of random numbers."""
    return np.resize(np.array([0.5, -1.25, 0.25, -0.75, 1.0, -0.125, 1.5]), (2, n, 3))


def ladder() -> list[Rung]:
    """Train the oracle for ten steps."""
    state = start(first_params())
    rungs = []
    for step in range(STEPS):
        state, loss = train_step(state, cameras()[step % 3], photographs()[step % 3], SCENE_SCALE, draws, RECIPE)
        rungs.append(Rung(loss, len(state.rows)))
    return rungs


if __name__ == "__main__":
    for rung in ladder():
        print(f"    Rung({rung.loss!r}, {rung.n}),")
