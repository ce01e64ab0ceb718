"""What a training minimises and when: POP, the rows of the paper's ablation tables, and two baselines, by name.

"3DGS" is Inria's code since October 2024, with whose counts the paper's row of that name agrees: renderer, loss, SSIM
padding, selection at the threshold, opacity rate, and no update in a step that edits the Gaussians. "3DGS 2023" is the
code before, whose opacities move twice as fast; other methods are built on it. Steps count from 0 in all. "gsplat" is
the default strategy of gsplat 1.5.

`BASELINES` is what the other methods of the paper's tables minimise, with which renderer, rates and rules; the steps of
density control that only they have are described where they are defined (`selection`, `taming`, `mini_splatting`, ...).

`L1_DIVIDED[n]` is "L1 div = n" of the paper's comparison of L1 and L2, `0.99 L1 / n + 0.01 D-SSIM`, otherwise as "L2":
no blur, no POP, no reset (A28).

Labels decided here: A1, A10, A12, A13, A16, A20, A22, A24, A28, A29.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from pop_ref.constants import INRIA, SPEEDY_SPLAT
from pop_ref.settings import GSPLAT, INRIA_RATES, LAMBDA_SSIM_3DGS, POP, LearningRates, Recipe, UpdateRules

__all__ = ["BASELINES", "L1_DIVIDED", "RECIPES", "Recipe"]

_NO_BLUR: Final = replace(POP, blur_stop_iter=GSPLAT.blur_stop_iter)

_INRIA: Final = Recipe(
    pixelwise="l1",
    lambda_ssim=LAMBDA_SSIM_3DGS,
    padding="same",
    lambda_pop=0.0,
    density=replace(GSPLAT, inclusive=True),
    profile=INRIA,
    updates=UpdateRules(edits_replace_update=True),
)

# "Reset" has blur but no POP, and no other row of the module ablation has resets (A22); "L2" has nothing else (A29).
# large Gaussians are pruned where opacities are reset, as in gsplat (A16).
# only so do the tables' counts fit together
RECIPES: Final = {
    "POP": Recipe(),
    "L2": Recipe(lambda_pop=0.0, density=_NO_BLUR),
    "L2+Blur": Recipe(lambda_pop=0.0),
    "L2+POP": Recipe(density=_NO_BLUR),
    "Reset": Recipe(
        lambda_pop=0.0, density=replace(POP, reset_every=GSPLAT.reset_every, prune_too_big=GSPLAT.prune_too_big)
    ),
    "3DGS": replace(_INRIA, lr=INRIA_RATES),
    "3DGS 2023": _INRIA,
    "gsplat": Recipe(pixelwise="l1", lambda_ssim=LAMBDA_SSIM_3DGS, lambda_pop=0.0, density=GSPLAT),
}

_MINI_STARTS: Final = (5_000, 10_000, 15_000, 20_000)
BASELINES: Final = {
    # two rounds after the whole of "3DGS 2023"
    "PUP-3DGS": replace(
        _INRIA,
        max_steps=40_000,
        updates=replace(_INRIA.updates, rounds_start_iter=30_000),
        adam_restarts=(30_000, 35_000),
    ),
    # no reset; blur by ten times POP's share of any view's pixels, always a split; colours without bands until 15,000
    "Mini-Splatting": replace(
        _INRIA,
        density=replace(
            _INRIA.density,
            reset_every=0,
            theta_blur=2e-4,
            blur_start_iter=0,
            blur_stop_iter=15_000,
            blur_window="any_view",
            blur_rule="split",
        ),
        updates=replace(_INRIA.updates, sh_start_iter=15_000, means_rewind_iter=15_000, means_rewind_to=5_000),
        adam_restarts=_MINI_STARTS,
    ),
    "Taming-3DGS": replace(
        _INRIA,
        density=replace(_INRIA.density, refine_every=500),
        lr=LearningRates(opacities=INRIA_RATES.opacities, sh_rest=2.0 * LearningRates.sh_rest),
        updates=replace(_INRIA.updates, sh_rest_every=16, opacities_stop_iter=15_000),
    ),
    "Speedy-Splat": replace(_INRIA, profile=SPEEDY_SPLAT),
}

L1_DIVIDED: Final = {n: replace(RECIPES["L2"], pixelwise="l1", pixel_scale=1.0 / n) for n in (1, 2, 5, 10, 20, 50, 100)}
