"""What a training minimises and when, and the rows of the paper's ablation tables under their names.

Labels decided here: A1, A10, A12, A13, A20, A22, A24, A28, A29.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal

from pop_ref.constants import PAPER, Profile
from pop_ref.density_config import ADC, POP, DensityConfig
from pop_ref.optimizer import MAX_STEPS, SH_DEGREE_INTERVAL
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
    "3DGS": Recipe(pixelwise="l1", lambda_ssim=0.2, lambda_pop=0.0, density=ADC),
}
