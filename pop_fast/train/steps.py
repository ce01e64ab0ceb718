"""What training steps are asked and what they report: their kind, Adam's schedule, settings, measurements, statistics.

The numbers of a step that runs as a whole, in C++ or on a GPU, go in and out as these values. `WholeStep` is such a
step as a backend offers it, with the settings that it knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from pop_ref.constants import Profile
from pop_ref.settings import BETAS, EPS, DensityConfig, Objective, Padding, Recipe

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from pop_fast.api.backend import Backend
    from pop_fast.train.config import TrainConfig


class Updates(NamedTuple):
    """Which parameters Adam moves at every step of a schedule, and how far: meaning in `pop_ref.optimizer`."""

    rates: Tensor  # learning rates, that of the means in world units. [steps, groups] float64
    # the number of the update, from 1, that the bias corrections are of; 0 where a parameter is not moved. [steps,
    # groups] int32
    numbers: Tensor
    # gradients of the bands beyond the first are summed up from one update to the next if it is > 1; else those of a
    # step without an update are lost, as all other parameters' are
    sh_rest_every: int = 1
    betas: tuple[float, float] = BETAS  # decay of Adam's first and second moments

    def __len__(self) -> int:
        return len(self.rates)


@dataclass(frozen=True)
class StepSettings:
    """What all steps of a run depend on."""

    updates: Updates  # which parameters Adam moves at which step
    # SSIM's border, by which photographs are prepared; that of every phase's objective
    padding: Padding = Recipe.padding
    lambda_pop: float = Recipe.lambda_pop  # weight of the POP term where it is on
    lambda_entropy: float = Recipe.lambda_entropy  # weight of the mean entropy of the opacities where it is on
    # important is what dominates a pixel of the "current" view, or of any view of the "window"
    pop_views: str = Recipe.pop_views
    # the POP term averages over "all" Gaussians, or over those "visible" in the view
    pop_over: str = Recipe.pop_over
    # under "any_view" a blur flag stays up, under "own_view" it is the last view's alone, under "sum" the caller
    # makes it of the summed counts
    blur_window: str = DensityConfig.blur_window
    theta_blur: float = DensityConfig.theta_blur  # share of the image a Gaussian must dominate to be blurred
    blur_min_pixels: float = DensityConfig.blur_min_pixels  # and at least so many pixels
    depth_weight: float = 0.0  # weight of the disparities at sparse points, the scene's scale included
    # opacity_reg, scale_reg: weights of the mean opacity and of the mean scale
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # colour behind everything
    # profile, antialiased: of the renderer
    profile: Profile = Recipe.profile
    antialiased: bool = False
    # backward, deterministic: of the step on a GPU, as `cuda_ext.arrays.Settings` says
    backward: str = "pixel_parallel"
    deterministic: bool = True
    eps: float = EPS
    # replay steps as CUDA graphs; False launches every kernel anew, for debuggers and profilers
    replay: bool = True
    counts: bool = False  # also tell how many splats every pixel blends and visits, which training does not read

    def blur_pixels(self, kept_pixels: int) -> float:
        """Return the whole number of pixels that a blurred Gaussian dominates more than, of a view's that count."""
        # counts are whole, so that rounding down changes no comparison and a float holds the bound exactly
        return float(math.floor(max(self.theta_blur * kept_pixels, self.blur_min_pixels)))


class Phase(NamedTuple):
    """What one kind of step does; steps of one phase and one image size share a graph."""

    sh_degree: int  # highest active colour band
    pop: bool  # the POP term is on
    statistics: bool  # screen gradients are collected
    blur: bool  # dominant pixels are collected
    objective: Objective = Objective()  # what the render is compared with its photograph by
    # dominant pixels are summed over the window for the POP term, also where blur is not asked for
    window: bool = False
    entropy: bool = False  # the entropy of the opacities is in the loss

    @property
    def dominance(self) -> bool:
        """Whether dominant Gaussians are asked for."""
        return self.pop or self.blur or self.window


class StepStats(NamedTuple):
    """Measurements of one step, the first five in the order of the compiled steps.

    An engine need not measure all of them at every step; NaN stands for what it has not measured.
    """

    pixelwise: float  # mean of the objective's pixelwise loss, without its weight
    ssim: float
    objective: float
    square: float  # mean square of the difference, the render clamped to [0, 1]
    # the weighted regularizers: the strategy's, as the POP term is, and those of the settings; 0 without any
    pop: float
    n_blended: float = math.nan  # Gaussians that a pixel blends, on average
    n_traversed: float = math.nan  # entries of its tile's list that a pixel visits, on average


@dataclass
class Collected:
    """What density control reads, one entry a Gaussian, added to by every step of a phase that collects it.

    `sh_rest_sum` is Adam's, of the same life: gradients that wait for their update; None where none do. [N, n_rest, 3]
    """

    grad_sum: Tensor
    n_visible: Tensor
    dominant_sum: Tensor
    blurred: Tensor
    sh_rest_sum: Tensor | None = None

    @classmethod
    def zeros(cls, n: int, device: torch.device, n_rest: int | None = None) -> Collected:
        """Start from nothing; `n_rest` bands' gradients wait, None for none."""
        import torch

        visible, dominant = (torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2))
        flags = torch.zeros(n, dtype=torch.uint8, device=device)
        waiting = None if n_rest is None else torch.zeros((n, n_rest, 3), device=device)
        return cls(torch.zeros(n, device=device), visible, dominant, flags, waiting)


# settings that a step need not know, with the one value that it trains with; "strategy." are the method's
_ONLY: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "batch_size": 1,
        "strategy.absgrad": False,
        "strategy.key_for_gradient": "means2d",
        "strategy.refine_scale2d_stop_iter": 0,
        "exposure": False,
        "random_background": False,
        "refine_cameras": False,
        "depth_lambda": 0.0,
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
    }
)


@dataclass(frozen=True)
class WholeStep:
    """What a backend offers in addition to its stages where it takes training steps by itself."""

    name: str  # of what takes the steps, for the statistics of a run
    # given a `pop_fast.train.stepper.Task`, returns what makes a `pop_fast.train.stepper.Fused`
    make: Callable[[Any], Callable[..., Any]]
    most: int  # steps at a time, however quick they are, before the program looks up: Ctrl-C, the progress bar
    losses: tuple[str, ...] = ("l2", "l1")  # names of the losses between pixels that it knows
    # settings by name, with the one value of each that it knows; those of the strategy begin with "strategy."
    only: Mapping[str, Any] = field(default_factory=lambda: _ONLY)
    depends_on_threads: bool = True  # whether another number of threads may round otherwise

    def unknown(self, config: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
        """Give name, value and the one known value of every setting that it does not know."""
        for name, known in self.only.items():
            group, _, inner = name.rpartition(".")
            value = getattr(config.strategy if group else config, inner)
            if value != known:
                yield f"{config.method}.{inner}" if group else name, value, known
        for loss in dict.fromkeys((config.photometric, config.objective_at(config.max_steps).pixelwise)):
            if loss not in self.losses:
                yield "photometric", loss, self.losses[0]

    def unknown_setting(self, config: TrainConfig) -> str | None:
        """Return the dotted name of a setting that it does not know, or None."""
        return next((name for name, _, _ in self.unknown(config)), None)


def why_not_trained(backend: Backend, config: TrainConfig, own_strategy: bool = True) -> str | None:
    """Return one sentence on why a backend cannot take the steps of a run and what to do, or None.

    Where the tensors are the CPU's, autograd over the stages takes whatever steps a whole one does not know.
    """
    if backend.device == "cpu":
        return None
    step, name = backend.whole_step(), backend.name
    if step is None:
        return f"backend {name!r} takes no training steps on {backend.device!r}; use --backend fast"
    if not own_strategy:
        return f"backend {name!r} trains with the strategies of this package only; use --backend fast"
    found = next(step.unknown(config), None)
    if found is None:
        return None
    setting, value, known = found
    if known is False and "." not in setting:
        option = setting.replace("_", "-")
        return f"backend {name!r} trains without {setting}; use --backend fast, or leave out --{option}"
    return (
        f"backend {name!r} trains with {setting} = {known!r} only, not {value!r}; "
        f"use --backend fast, or leave {setting} as it is"
    )
