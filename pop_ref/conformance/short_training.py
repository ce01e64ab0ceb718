"""Trainings on photographs: small scenes, several views, and the few steps that a method takes there.

Photographs are noise, so that every pixel pulls. Seeds are such that rounding decides no pixel at the start.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from pop_ref.conformance.strategy_script import Draws
from pop_ref.conformance.views import cameras, gaussians
from pop_ref.records import Camera

DEGREE: Final = 2
SIZE: Final = 13, 11


@dataclass(frozen=True)
class ShortTraining:
    """A method, its settings, and the photographs that it is trained on.

    Attributes:
        method: one of `pop_ref.methods.RECIPE_OF`.
        settings: of its strategy, by name; others are those of its recipe.
        options: of the rest of its recipe, by the names of `Recipe`; others are its own.
        order: the view of every step; a training that draws its order itself takes as many steps.
        seed: of Gaussians and photographs.
        count: of Gaussians.
        views: to train on.
        held_out: further views, which are not trained on.
        scene_scale: world units.
        masked: whether pixels of the views do not count.
        background: colour behind everything.
        antialiased: whether opacities make up for the low-pass.
        batch: views of a step.
        sparse: sparse points, of which every photograph sees its own; 0 for none.
        size: width and height of all views, px.
        centred: whether principal points are the middle of the image, as Inria's code takes them to be.
    """

    method: str = "pop"
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    options: Mapping[str, Any] = field(default_factory=dict[str, Any])
    order: tuple[int, ...] = (0, 1, 0, 1)
    seed: int = 0
    count: int = 6
    views: int = 2
    held_out: int = 0
    scene_scale: float = 1.0
    masked: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = False
    batch: int = 1
    sparse: int = 0
    size: tuple[int, int] = SIZE
    centred: bool = False

    @property
    def steps(self) -> int:
        """Return how many steps are taken."""
        return len(self.order) // self.batch

    @functools.cached_property
    def params(self) -> Mapping[str, np.ndarray]:
        """Return raw parameters in numbers of single precision."""
        g = gaussians(self.seed, DEGREE, self.count, self.size)
        raw = {
            "means": g.means,
            "scales": np.log(g.scales),
            "quats": g.quats,
            "opacities": np.log(g.opacities / (1.0 - g.opacities)),
            "sh0": g.sh[:, :1],
            "shN": g.sh[:, 1:],
        }
        return {name: _single(array) for name, array in raw.items()}

    @functools.cached_property
    def cameras(self) -> list[Camera]:
        """Return the cameras of the views that are trained on, in numbers of single precision."""
        return self._every_camera[: self.views]

    @functools.cached_property
    def held_out_cameras(self) -> list[Camera]:
        """Return the cameras of the other views."""
        return self._every_camera[self.views :]

    @functools.cached_property
    def _every_camera(self) -> list[Camera]:
        every = cameras(self.views + self.held_out, self.centred, self.size)
        # held-out ones see a corner of what the others see, four times as large
        near = [np.diag([1.0, 1.0, 1.0]) if k < self.views else np.diag([4.0, 4.0, 1.0]) for k in range(len(every))]
        return [
            Camera(_single(c.viewmat), _single(larger @ c.K), c.width, c.height)
            for c, larger in zip(every, near, strict=True)
        ]

    def photo(self, index: int) -> np.ndarray:
        """Return the photograph of a view, held-out ones counted on. uint8 [H, W, 3]"""
        width, height = self.size
        return self._rng(0, index).integers(0, 256, (height, width, 3), np.uint8)

    def mask(self, index: int) -> np.ndarray | None:
        """Return which pixels of a view count, None for all. [H, W]"""
        width, height = self.size
        return self._rng(1, index).random((height, width)) < 0.75 if self.masked else None

    @functools.cached_property
    def cloud(self) -> np.ndarray:
        """Return all sparse points, world. [P, 3]"""
        return _single(self.params["means"][-1] + self._rng(2).normal(0.0, 0.5, (self.sparse, 3)))

    def seen(self, index: int) -> np.ndarray:
        """Return which sparse points a photograph sees: every photograph others. [M]"""
        return np.arange(index % 3, self.sparse, 3)

    def points(self, index: int) -> np.ndarray | None:
        """Return the sparse points that a photograph sees, None where there are none. [M, 3]"""
        return self.cloud[self.seen(index)] if self.sparse else None

    def draws(self) -> Draws:
        """Return the random numbers of the training."""
        return Draws(self._rng(3))

    def _rng(self, *of: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, *of])


def _single(array: np.ndarray) -> np.ndarray:
    return np.asarray(array, dtype=np.float32).astype(np.float64)
