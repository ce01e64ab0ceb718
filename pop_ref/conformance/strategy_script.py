"""Training without pictures: what a rasterizer would have said at every step, written down, to drive a strategy by.

A script is made of formulas of the step and of the number of Gaussians, so that everybody who is driven by it sees the
same. Numbers are dyadic: no precision rounds them, and averages over one, two or four views are exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from pop_ref.contributions import Contributions
from pop_ref.density_rows import Rows
from pop_ref.methods import KEYS, RECIPE_OF
from pop_ref.scripted import Pass, ScriptedView
from pop_ref.settings import LearningRates

# the kit's names of the methods whose every step it knows
METHODS: Final = tuple(RECIPE_OF)
# exact in every precision
RATES: Final = LearningRates(means=2.0**-6, scales=2.0**-7, quats=2.0**-9, opacities=2.0**-5)
# steps between two raises of the harmonics' degree
SH_INTERVAL: Final = 4


@dataclass(frozen=True)
class Script:
    """A strategy, the steps that it is taken through, and all that it is shown there.

    Attributes:
        method: one of METHODS; None for the strategy that a backend has.
        settings: of the strategy, by the names of `pop_ref.settings` and of the methods' own.
        steps: numbers, ascending; those between are left out.
        n: Gaussians at the start.
        cameras: of every render.
        packed: whether a render tells of visible Gaussians only.
        quiet: no gradients, so that Adam moves nobody.
        seed: of all formulas.
        scene_scale: world units.
        max_steps: of the schedule.
        n_views: to pass over.
    """

    method: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    steps: tuple[int, ...] = (1, 2, 3)
    n: int = 6
    cameras: int = 1
    packed: bool = False
    quiet: bool = False
    seed: int = 0
    scene_scale: float = 1.0
    max_steps: int = 40
    n_views: int = 3
    width: int = 16
    height: int = 8
    lr: LearningRates = RATES

    def rows(self) -> Rows:
        """Return the Gaussians to start from: every number of a row tells its tag, moments are not zero."""
        rng, tag = self._rng(0), np.arange(1.0, self.n + 1.0)
        params = {
            "means": tag[:, None] * np.array([1.0, 2.0, 4.0]),
            "scales": np.log(self.scene_scale * rng.choice([0.125, 0.25, 0.5, 0.75], (self.n, 3))),
            "quats": rng.integers(-8, 9, (self.n, 4)) / 4.0 + np.array([4.0, 0.0, 0.0, 0.0]),
            "opacities": rng.choice([-9.0, -2.0, 0.25, 3.0], self.n),
            "sh0": tag[:, None, None] * np.ones((1, 1, 3)),
            "shN": tag[:, None, None] * np.ones((1, 15, 3)),
        }
        weight = 0.0 if self.quiet else 1.0
        m = {name: weight * rng.integers(1, 9, array.shape) / 16.0 for name, array in params.items()}
        return Rows(params, m, {name: weight * (1.0 + array) for name, array in m.items()})

    def view(self, step: int, n: int) -> ScriptedView:
        """Return what the render of a step says of n Gaussians."""
        rng, shape = self._rng(1, step, n), (self.cameras, n)
        # along one axis, so that a norm is exact; of the mean over cameras, whose number scales it up again
        v = rng.choice([0.0, 2.0**-5, 2.0**-4, -(2.0**-4), 2.0**-3, -(2.0**-2)], shape) / self.cameras
        # some say that they are not seen along one axis alone, as of extents of 0 and 1
        radii = rng.integers(0, 6, (*shape, 2)) * (rng.random((*shape, 1)) < 0.7)
        seen = np.all(radii > 0, axis=2)
        v_means2d = np.where(seen, v, 0.0)[..., None] * np.eye(2)[rng.integers(0, 2, shape)]
        counts = rng.choice([0, 0, 1, 2, 5, 9], shape) * seen
        kept = None if step % 3 else self.width * self.height // 2
        return ScriptedView(v_means2d, 2.0 * np.abs(v_means2d) * (1 + np.arange(n) % 2)[:, None], radii, counts, kept)

    def gradients(self, step: int, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
        """Return gradients of the raw parameters; the strategy's own term is not among them."""
        rng = self._rng(2, step, shapes["means"][0])
        drawn = {name: rng.integers(-8, 9, shapes[name]) / 8.0 for name in KEYS}
        return {name: 0.0 * g for name, g in drawn.items()} if self.quiet else drawn

    def over(self, index: int, n: int, sh_degree: int = 0, divisor: int = 1) -> Pass:
        """Return what the pass over a training view, drawn with so many bands and so much smaller, says of n Gaussians.

        Nothing of it is alike for two numbers of any of these.
        """
        rng, (H, W) = self._rng(3, index, n, sh_degree, divisor), (self.height, self.width)
        weights, n_pixels = rng.integers(0, 64, n) / 8.0, rng.integers(0, 32, n)
        root = rng.integers(-4, 5, (n, 6, 6)) / 4.0
        return Pass(
            found=Contributions(weights, n_pixels, rng.integers(0, 16, n) / 4.0, rng.integers(0, 64, n) / 8.0),
            dominant_counts=rng.choice([0, 0, 3, 8], n),
            radii=rng.integers(0, 5, (n, 2)),
            depths=rng.integers(8, 64, n) / 8.0,
            image=rng.integers(0, 9, (H, W, 3)) / 8.0,
            sensitivities=rng.permutation(4 * n)[:n] / 8.0,
            blocks=root @ np.swapaxes(root, 1, 2) + np.eye(6),
            points=rng.integers(-64, 65, (H, W, 3)) / 16.0,
            ids=rng.integers(-1, n, (H, W)),
            T_final=rng.integers(0, 8, (H, W)) / 8.0,
        )

    def photo(self, index: int) -> np.ndarray:
        """Return the photograph of a training view. uint8 [H, W, 3]"""
        return self._rng(5, index).integers(0, 256, (self.height, self.width, 3)).astype(np.uint8)

    def mask(self, index: int) -> np.ndarray | None:
        """Return which pixels of a training view count; None for all. [H, W]"""
        return self._rng(6, index).random((self.height, self.width)) < 0.5 if index == 1 else None

    def draws(self) -> Draws:
        """Return the random numbers of a drive, which whoever is driven takes in the same order."""
        return Draws(self._rng(4))

    def sh_degree(self, step: int) -> int:
        """Return the bands that are drawn at a step."""
        return min(step // SH_INTERVAL, 3)

    def _rng(self, *of: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *of])


class Draws:
    """Random numbers, one after the other."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def normals(self, n: int) -> np.ndarray:
        """Draw for the children of n split parents, in eighths. [2, n, 3]"""
        return np.round(8.0 * self._rng.standard_normal((2, n, 3))) / 8.0

    def uniforms(self, n: int) -> np.ndarray:
        """Draw from [0, 1). [n]"""
        return self._rng.random(n)
