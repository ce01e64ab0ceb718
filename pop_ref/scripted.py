"""What a training is shown by whoever writes it down: renders, passes over views, random numbers.

`methods.scripted_steps` takes a method through such a script; `pop_ref.conformance.strategy_script` writes some.
`short_training.taken_steps` takes one through a short training, where photographs are what it is shown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from pop_ref.contributions import Contributions
from pop_ref.records import Camera
from pop_ref.settings import LearningRates


@dataclass(frozen=True)
class ScriptedView:
    """What a render of C cameras and its backward pass say of N Gaussians.

    Attributes:
        v_means2d, absolute: gradient of the mean loss by the screen centres, per px, and the sum of its absolute
            values over pixels. [C, N, 2]
        radii: extents, px; 0 on both axes where a camera does not see the Gaussian. [C, N, 2]
        dominant_counts: pixels that each dominates, of those that a mask keeps. [C, N]
        kept_pixels: how many a mask keeps; None without a mask.
    """

    v_means2d: np.ndarray
    absolute: np.ndarray
    radii: np.ndarray
    dominant_counts: np.ndarray
    kept_pixels: int | None

    @property
    def visible(self) -> np.ndarray:
        """Tell which Gaussians each camera sees. [C, N]"""
        return np.all(self.radii > 0, axis=2)


@dataclass(frozen=True)
class Pass:
    """What a pass over a training view says of N Gaussians.

    Attributes:
        found: sums over the view's pixels; `map_sum` is the share of each in a map's mean.
        dominant_counts, radii, depths: [N], [N, 2], [N]
        image: [H, W, 3]
        sensitivities, blocks: scores of Speedy-Splat and PUP-3DGS. [N], [N, 6, 6]
        points, ids, T_final: of each pixel. [H, W, 3], [H, W], [H, W]
    """

    found: Contributions
    dominant_counts: np.ndarray
    radii: np.ndarray
    depths: np.ndarray
    image: np.ndarray
    sensitivities: np.ndarray
    blocks: np.ndarray
    points: np.ndarray
    ids: np.ndarray
    T_final: np.ndarray


class Draws(Protocol):
    """Random numbers, one after the other."""

    def normals(self, n: int) -> np.ndarray:
        """Draw for the children of n split parents. [2, n, 3]"""
        ...

    def uniforms(self, n: int) -> np.ndarray:
        """Draw from [0, 1). [n]"""
        ...


class Script(Protocol):
    """What a training is shown.

    Attributes:
        method: one of RECIPE_OF.
        settings: of its strategy, by name; others are those of its recipe.
        steps: numbers, ascending.
        cameras: of every render.
        scene_scale: world units.
        max_steps: of the schedule.
        n_views: to pass over.
        width, height: of all views, px.
        lr: learning rates.
    """

    method: str
    settings: Mapping[str, Any]
    steps: tuple[int, ...]
    cameras: int
    scene_scale: float
    max_steps: int
    n_views: int
    width: int
    height: int
    lr: LearningRates

    def view(self, step: int, n: int) -> ScriptedView:
        """Return what the render of a step says of n Gaussians."""
        ...

    def gradients(self, step: int, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
        """Return gradients of the raw parameters, without the prior's."""
        ...

    def over(self, index: int, n: int, sh_degree: int = 0, divisor: int = 1) -> Pass:
        """Return what the pass over a view, drawn with so many bands and so much smaller, says of n Gaussians."""
        ...

    def photo(self, index: int) -> np.ndarray:
        """Return the photograph of a view. uint8 [H, W, 3]"""
        ...

    def mask(self, index: int) -> np.ndarray | None:
        """Return which pixels of a view count, None for all. [H, W]"""
        ...

    def draws(self) -> Draws:
        """Return the random numbers of a training."""
        ...

    def sh_degree(self, step: int) -> int:
        """Return the bands that are drawn at a step."""
        ...


class ShortTraining(Protocol):
    """A training on photographs.

    Attributes:
        method: one of RECIPE_OF.
        settings: of its strategy, by name; others are those of its recipe.
        options: of the rest of its recipe, by the names of `Recipe`; others are its own.
        order: the views in the order in which steps see them.
        batch: views of a step, whose losses and gradients are averaged; density control sees one after the other.
        scene_scale: world units.
        background: colour behind everything. [3]
        antialiased: whether opacities make up for the low-pass.
    """

    method: str
    settings: Mapping[str, Any]
    options: Mapping[str, Any]
    order: tuple[int, ...]
    batch: int
    scene_scale: float
    background: tuple[float, float, float]
    antialiased: bool

    @property
    def params(self) -> Mapping[str, np.ndarray]:
        """Return raw parameters to start from."""
        ...

    @property
    def cameras(self) -> list[Camera]:
        """Return the cameras of the views that are trained on."""
        ...

    def photo(self, index: int) -> np.ndarray:
        """Return the photograph of a view. uint8 [H, W, 3]"""
        ...

    def mask(self, index: int) -> np.ndarray | None:
        """Return which pixels of a view count, None for all. [H, W]"""
        ...

    def points(self, index: int) -> np.ndarray | None:
        """Return the sparse points that a photograph sees, None where none are known. [P, 3]"""
        ...

    def draws(self) -> Draws:
        """Return the random numbers of the training."""
        ...
