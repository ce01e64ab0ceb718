"""The scales that a row can be run at: which scenes, how much of the schedule, what of the settings differs and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from paper_repro.scenes import SCENES
from pop_fast.errors import PopError


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How much of the published protocol a run follows.

    Attributes:
        name: its name in results and on the command line.
        about: one sentence for people.
        factors: its scenes, each with what its photographs are shrunk by after they were read, by the scenes' files.
        steps_scaler: multiplies every step number of the method.
        settings: what else differs from the method's own values, in the names of `pop_fast.train.TrainConfig`; those
            of density control under "strategy.".
        of_methods: what else differs for one method alone, likewise.
        reset_every: steps between two resets, for the rows that have resets, and the step after which large Gaussians
            are pruned, for the rows that prune them; None leaves both as the scaled schedule has them, no sooner than
            3,000 steps.
        log_every: steps between two points of the curves.
        checkpoint_every: steps that a kill can cost.
    """

    name: str
    about: str
    factors: Mapping[str, int]
    steps_scaler: float = 1.0
    settings: Mapping[str, Any] = field(default_factory=dict)
    of_methods: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    reset_every: int | None = None
    log_every: int = 100
    checkpoint_every: int = 500


def _factors(scale: str) -> dict[str, int]:
    return {scene.name: scene.factors[scale] for scene in SCENES.values() if scale in scene.factors}


# theta_blur comes to 10.7 pixels in the paper's smallest images, and to less in images smaller than those
_FLOOR: Final = {"strategy.blur_min_pixels": 10.0}

# Mini-Splatting's 3.5 million points are one to three of a hundred pixels of the paper's views; so many are these
_POINTS: Final = {
    scale: {"mini-splatting": {"strategy.reinit_points": count}}
    for scale, count in (("toy", 3_000), ("shown", 50_000), ("small", 200_000), ("full", 1_000_000))
}

_ALL: Final = (
    Scale(
        name="toy",
        about="the demo capture in seconds: that everything runs, and nothing more",
        factors=_factors("toy"),
        # 300 steps, in which density control acts 14 times and resets, where it does, at 30, 60, 90 and 120
        steps_scaler=0.01,
        settings={**_FLOOR, "strategy.refine_every": 10},
        of_methods=_POINTS["toy"],
        reset_every=30,
        log_every=10,
        checkpoint_every=100,
    ),
    Scale(
        name="shown",
        about="the still life of the demo at its size, a tenth of the schedule: pictures that may be published",
        factors=_factors("shown"),
        steps_scaler=0.1,
        settings=_FLOOR,
        of_methods=_POINTS["shown"],
    ),
    Scale(
        name="small",
        about="real photographs for a CPU: the whole schedule, small images, theta_blur at least 10 pixels",
        factors=_factors("small"),
        settings=_FLOOR,
        of_methods=_POINTS["small"],
    ),
    Scale(
        name="no_floor",
        about="fox at half its size and the whole schedule, where theta_blur is 10.4 pixels by itself",
        factors=_factors("no_floor"),
        of_methods=_POINTS["small"],
    ),
    Scale(
        name="full",
        about="bonsai_800 at its size and the whole schedule, theta_blur at least 10 pixels",
        factors=_factors("full"),
        settings=_FLOOR,
        of_methods=_POINTS["full"],
        log_every=25,
    ),
    Scale(
        name="paper",
        about="the published protocol",
        factors=_factors("paper"),
        checkpoint_every=1_000,
    ),
)
SCALES: Final = {scale.name: scale for scale in _ALL}
for _scene in SCENES.values():
    for _name in _scene.factors:
        if _name not in SCALES:
            raise PopError(f"scenes/{_scene.name}.toml: factors.{_name} is not a scale; they are {', '.join(SCALES)}")


def scale_named(name: str) -> Scale:
    """Return a scale by its name.

    Raises:
        PopError: there is none of this name; names them all.
    """
    if name not in SCALES:
        raise PopError(f"scale is '{name}'; it must be one of {', '.join(SCALES)}")
    return SCALES[name]
