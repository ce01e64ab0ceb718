"""What a training minimises and when: POP, the rows of the paper's ablation tables, and two baselines, by name.

"3DGS" is Inria's code since October 2024, with whose counts the paper's row of that name agrees: renderer, loss, SSIM
padding, selection at the threshold, opacity rate. What a recipe cannot say stays as in every training here: steps count
from 0, and population edits follow Adam, where Inria's come before it and lose that step's update. "gsplat" is the
default strategy of gsplat 1.5.

`L1_DIVIDED[n]` is "L1 div = n" of the paper's comparison of L1 and L2, `0.99 L1 / n + 0.01 D-SSIM`, otherwise as "L2":
no blur, no POP, no reset (A28).

Labels decided here: A1, A10, A12, A13, A20, A22, A24, A28, A29.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

from pop_ref.constants import INRIA, PAPER, Profile
from pop_ref.density_config import ADC, POP, DensityConfig
from pop_ref.optimizer import LEARNING_RATES, MAX_STEPS, SH_DEGREE_INTERVAL
from pop_ref.ssim import Padding


@dataclass(frozen=True)
class Recipe:
    """What a training minimises, and its calendar; the defaults are POP's.

    Attributes:
        pixelwise: "l2" for eq. 9, "l1" for eq. 2.
        pixel_scale: factor on that term (A10, A28).
        lambda_ssim: weight of D-SSIM; the rest, to 1, is the pixelwise term's.
        padding: of SSIM.
        d_ssim_halved: D-SSIM as (1 - SSIM) / 2 (A11).
        l2_stop_iter: step from which eq. 2 with lambda 0.2 takes over; None never, as only POP is said to stop (A20).
        lambda_pop: weight of the POP term.
        pop_start_iter: first step with the POP term (A13: from the start).
        pop_stop_iter: first step without it.
        pop_views: "current" takes importance from the current view, "window" from all views since the last event (A1).
        pop_over: "all" sums over all Gaussians, "visible" over those the view shows (A12).
        density: of the population.
        opacity_rate: learning rate of the opacities.
        max_steps: length of the training, over which the positions' learning rate decays.
        sh_interval: steps between two raises of the harmonics' degree.
        profile: of the renderer (A24).
    """

    pixelwise: Literal["l1", "l2"] = "l2"
    pixel_scale: float = 1.0
    lambda_ssim: float = 0.01
    padding: Padding = "valid"
    d_ssim_halved: bool = False
    l2_stop_iter: int | None = None
    lambda_pop: float = 1e-3
    pop_start_iter: int = 0
    pop_stop_iter: int = 15_000
    pop_views: Literal["current", "window"] = "current"
    pop_over: Literal["all", "visible"] = "all"
    density: DensityConfig = POP
    opacity_rate: float = LEARNING_RATES["opacities"]
    max_steps: int = MAX_STEPS
    sh_interval: int = SH_DEGREE_INTERVAL
    profile: Profile = PAPER


_NO_BLUR: Final = replace(POP, blur_start_iter=0, blur_stop_iter=-1)

# "Reset" has blur but no POP, and no other row of the module ablation has resets (A22); "L2" has nothing else (A29).
# only so do the tables' counts fit together
RECIPES: Final = {
    "POP": Recipe(),
    "L2": Recipe(lambda_pop=0.0, density=_NO_BLUR),
    "L2+Blur": Recipe(lambda_pop=0.0),
    "L2+POP": Recipe(density=_NO_BLUR),
    "Reset": Recipe(lambda_pop=0.0, density=replace(POP, reset_every=3000)),
    "3DGS": Recipe(
        pixelwise="l1",
        lambda_ssim=0.2,
        padding="same",
        lambda_pop=0.0,
        density=replace(ADC, inclusive=True),
        opacity_rate=0.025,
        profile=INRIA,
    ),
    "gsplat": Recipe(pixelwise="l1", lambda_ssim=0.2, lambda_pop=0.0, density=ADC),
}

L1_DIVIDED: Final = {n: replace(RECIPES["L2"], pixelwise="l1", pixel_scale=1.0 / n) for n in (1, 2, 5, 10, 20, 50, 100)}
