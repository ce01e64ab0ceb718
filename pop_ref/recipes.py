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

from dataclasses import replace
from typing import Final

from pop_ref.constants import INRIA
from pop_ref.settings import GSPLAT, INRIA_RATES, LAMBDA_SSIM_3DGS, POP, Recipe

__all__ = ["L1_DIVIDED", "RECIPES", "Recipe"]

_NO_BLUR: Final = replace(POP, blur_stop_iter=GSPLAT.blur_stop_iter)

# "Reset" has blur but no POP, and no other row of the module ablation has resets (A22); "L2" has nothing else (A29).
# only so do the tables' counts fit together
RECIPES: Final = {
    "POP": Recipe(),
    "L2": Recipe(lambda_pop=0.0, density=_NO_BLUR),
    "L2+Blur": Recipe(lambda_pop=0.0),
    "L2+POP": Recipe(density=_NO_BLUR),
    "Reset": Recipe(lambda_pop=0.0, density=replace(POP, reset_every=GSPLAT.reset_every)),
    "3DGS": Recipe(
        pixelwise="l1",
        lambda_ssim=LAMBDA_SSIM_3DGS,
        padding="same",
        lambda_pop=0.0,
        density=replace(GSPLAT, inclusive=True),
        lr=INRIA_RATES,
        profile=INRIA,
    ),
    "gsplat": Recipe(pixelwise="l1", lambda_ssim=LAMBDA_SSIM_3DGS, lambda_pop=0.0, density=GSPLAT),
}

L1_DIVIDED: Final = {n: replace(RECIPES["L2"], pixelwise="l1", pixel_scale=1.0 / n) for n in (1, 2, 5, 10, 20, 50, 100)}
