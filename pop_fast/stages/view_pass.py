"""What a pass over a view is given, and what every backend's pass answers; `pop_fast.density.passes` makes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from pop_fast.stages.chord import DominantPoints
from pop_fast.stages.contributions import Contributions
from pop_fast.stages.types import Camera, Gaussians
from pop_ref.constants import Profile


@dataclass(frozen=True)
class Seen:
    """A view before its sums.

    Attributes:
        image: [H, W, 3]
        dominant_ids: -1 where none. [H, W]
        radii: [N, 2]
        depths: [N]
    """

    image: Tensor
    dominant_ids: Tensor
    radii: Tensor
    depths: Tensor


@dataclass(frozen=True)
class PassInput:
    """What a pass draws: Gaussians, a camera, the bands of their colours in use, and how.

    Attributes:
        gaussians: activated.
        camera: the view.
        sh_degree: bands to use.
        background: colour behind everything. [3]
        profile: constants and strictness.
        antialiased: scale opacities by the antialiasing factor.
    """

    gaussians: Gaussians
    camera: Camera
    sh_degree: int
    background: Tensor
    profile: Profile
    antialiased: bool


class ViewPass(Protocol):
    """A shot that has been projected and listed."""

    def seen(self) -> Seen:
        """Draw it."""
        ...

    def contributions(self, pixel_map: Tensor | None) -> Contributions:
        """As `pop_fast.stages.contributions.contributions`."""
        ...

    def sensitivities(self) -> Tensor:
        """As `pop_fast.stages.sensitivity.sensitivities`."""
        ...

    def fisher_blocks(self) -> Tensor:
        """As `pop_fast.stages.fisher.fisher_blocks`, of its own screen moments."""
        ...

    def dominant_points(self) -> DominantPoints:
        """As `pop_fast.stages.chord.dominant_points`."""
        ...
