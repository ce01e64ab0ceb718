"""Training without pictures: what a rasterizer would have said at every step, written down, to drive a strategy by.

A script is made of formulas of the step and of the number of Gaussians, so that every strategy that it drives sees the
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
            # of the later views much is brighter than white
            image=(1 + 2 * index) * rng.integers(0, 9, (H, W, 3)) / 8.0,
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


EVERY_STEP: Final = tuple(range(1, 40))
GROWTH: Final[dict[str, Any]] = {
    "refine_start_iter": 3,
    "refine_stop_iter": 30,
    "refine_every": 4,
    "grow_grad2d": 0.5,
    "grow_scale3d": 0.3,
    "prune_opa": 0.05,
    "prune_scale3d": 0.6,
    "prune_too_big_after": 8,
}
RESETS: Final[dict[str, Any]] = {"reset_every": 12, "reset_opa": 0.2}
BLUR: Final[dict[str, Any]] = {"theta_blur": 4.0 / 128.0, "blur_start_iter": 8, "blur_stop_iter": 20}
OWN: Final[dict[str, dict[str, Any]]] = {
    "pop": {**BLUR, "lambda_pop": 0.5, "pop_start_iter": 2, "pop_stop_iter": 26},
    "gsplat": RESETS,
    "3dgs": RESETS,
    "mini-splatting": {
        "theta_blur": 4.0 / 128.0,
        "blur_stop_iter": 18,
        "sh_start_iter": 12,
        "means_rewind_iter": 18,
        "means_rewind_to": 6,
        "reinit_iters": (7,),
        "reinit_points": 60,
        "sample_iter": 18,
        "prune_iter": 34,
        "prune_mass": 0.125,
    },
    "taming": {
        **RESETS,
        "opacities_stop_iter": 24,
        "sh_rest_every": 4,
        "budget_multiplier": 4.0,
        "score_views": 2,
        "sampled_prunes": 5,
        "grow_grad2d": 0.125,
        "prune_opa": 0.3,
    },
    "speedy-splat": {**RESETS, "soft_prune_iters": (12, 20), "soft_prune_share": 0.5, "hard_prune_iters": (33,)},
    "pup": {**RESETS, "rounds_start_iter": 32, "round_steps": 4, "round_decay_every": 2, "prune_shares": (0.5, 0.25)},
}


def script_of(method: str, n: int = 12, **changes: Any) -> Script:
    """Return a training by a method under settings in which all that it does happens within forty steps."""
    settings = {**GROWTH, **OWN.get(method, {}), **changes.pop("settings", {})}
    return Script(method, settings, **{"steps": EVERY_STEP, "n": n, **changes})


def trainings_of(method: str) -> tuple[Script, Script]:
    """Return two trainings by a method: of one camera, and of two cameras whose renders are packed."""
    settings = {"absgrad": True, "grow_grad2d": 1.0}
    return script_of(method), script_of(method, cameras=2, packed=True, seed=1, scene_scale=4.0, settings=settings)


SCREEN: Final = {"refine_scale2d_stop_iter": 20, "grow_scale2d": 0.2, "prune_scale2d": 0.29}
_READINGS: Final[tuple[tuple[str, dict[str, Any], dict[str, Any]], ...]] = (
    ("pop", {"blur_window": "any_view", "blur_rule": "split", "revised_opacity": True}, {}),
    ("pop", {"blur_window": "sum", "grad_denominator": "window", "blur_min_pixels": 6.0}, {"cameras": 2}),
    ("pop", {"pop_views": "window", "grow_on_gradient": False}, {}),
    ("pop", {"pop_over": "visible", "grow_on_gradient_in_blur_window": False}, {"cameras": 2, "packed": True}),
    ("pop", {"lambda_pop": 0.0, "lambda_entropy": 0.25, "final_prune_iter": 33, "final_prune_opa": 0.5}, {}),
    ("pop", {"lambda_entropy": 0.25, **SCREEN}, {}),
    ("gsplat", {**SCREEN, "inclusive": True, "pause_refine_after_reset": 3}, {"cameras": 2, "packed": True}),
    ("gsplat", {"sh_rest_every": 3, "edits_replace_update": True, "revised_opacity": True}, {}),
    ("gsplat", {"prune_opa": 0.3, "prune_too_big": False}, {"steps": EVERY_STEP[:14]}),
    ("mini-splatting", {**RESETS, "importance": "outdoor", "max_gaussians": 40}, {"cameras": 2}),
    ("taming", {"final_count": 30, "misaligned_prune_weights": False}, {"packed": True}),
    # bounds that extents come up to, 3 and 4 of 16 px
    (
        "pop",
        {**SCREEN, "grow_scale2d": 0.1875, "prune_scale2d": 0.25, "prune_opa": 0.3, "revised_opacity": True},
        {"width": 8, "height": 16},
    ),
    # more points asked for than pixels are shown
    ("mini-splatting", {"grad_denominator": "window", "reinit_points": 400}, {"steps": EVERY_STEP[:10]}),
)
# trainings under every other reading of a method
READINGS: Final = tuple(
    script_of(method, settings=settings, seed=seed, **{"steps": EVERY_STEP[:34], **more})
    for seed, (method, settings, more) in enumerate(_READINGS)
)
# of trainings in which one rule meets another, or a number its limit
MEETINGS: Final = (
    # a last prune between two changes, whose window goes on
    script_of("pop", settings={"final_prune_iter": 10, "final_prune_opa": 0.5}, seed=3, steps=EVERY_STEP[:20]),
    # and one right after a reset, which leaves nobody
    script_of("gsplat", settings={"final_prune_iter": 12, "final_prune_opa": 0.5}, seed=3, steps=EVERY_STEP[:16]),
    # a prior that reads the window when nothing grows any more
    script_of("pop", settings={"pop_views": "window", "refine_stop_iter": 9}, seed=3, steps=EVERY_STEP[:20]),
    # as many Gaussians as may be, and a share that leaves half a Gaussian over
    script_of("mini-splatting", settings={"max_gaussians": 12, "sampling_factor": 0.7}, steps=EVERY_STEP[:18]),
)
