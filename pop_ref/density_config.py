"""Every constant and every switch of density control, and when its events happen.

Steps count from 0 as in gsplat: the event of step s follows the Adam update of step s. `DensityConfig` holds every
number and every reading of the paper that can be chosen; its attributes name the ambiguity (A2 ... A29) they decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


@dataclass(frozen=True)
class DensityConfig:
    """Every constant and every switch of density control; the defaults are POP's.

    Attributes:
        prune_opa: an opacity under it is pruned (A15: gsplat's default).
        grow_grad2d: tau_Den, in NDC units (A9: not retuned for L2).
        inclusive: True selects `>=` tau_Den as Inria does, False `>` as gsplat does.
        grad_denominator: "visible_views" averages over the views that saw the Gaussian, "window" over all (A23).
        grow_on_gradient: use the gradient rule, eq. 3 (A8: beside the blur rule).
        grow_on_gradient_in_blur_window: ... also inside the blur window, where else the blur rule works alone (A8).
        grow_scale3d: a Gaussian is small if its largest scale is at most this share of the scene's (A14).
        prune_too_big: prune Gaussians that grow excessively large (A16: kept although the reset is gone).
        prune_scale3d: excessively large is above this share of the scene's scale (A16).
        prune_too_big_after: ... and only at steps after this one (A16: not tied to `reset_every`).
        refine_start_iter: events happen at steps after it.
        refine_stop_iter: events happen at steps before it (A17: pruning too ends there).
        refine_every: an event each so many steps (A17: pruning happens with each).
        theta_blur: share of a view's pixels above which a Gaussian is blurred (eq. 6; A18: of each view's own size).
        blur_start_iter: first step of the blur window, inclusive.
        blur_stop_iter: last step of the blur window, inclusive (A19); under `blur_start_iter` there is none.
        blur_window: "any_view" tests each view by itself and keeps the flag until the event, "sum" adds the
            counts of the window up and tests the sum, "own_view" tests the event's own view only (A2).
        blur_rule: "by_scale" clones small blurred Gaussians and splits large ones, "split" splits all (A14).
        revised_opacity: split children get 1 - sqrt(1 - o) instead of o (A26).
        reset_every: reset opacities each so many steps before `refine_stop_iter`; 0 never (A22, A29).
        reset_at_zero: reset at step 0 as well, as gsplat up to 1.5.2 does (A25).
        reset_opa: the ceiling of a reset.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 2e-4
    inclusive: bool = False
    grad_denominator: Literal["visible_views", "window"] = "visible_views"
    grow_on_gradient: bool = True
    grow_on_gradient_in_blur_window: bool = True
    grow_scale3d: float = 0.01
    prune_too_big: bool = True
    prune_scale3d: float = 0.1
    prune_too_big_after: int = 3000
    refine_start_iter: int = 500
    refine_stop_iter: int = 15_000
    refine_every: int = 100
    theta_blur: float = 2e-5
    blur_start_iter: int = 3000
    blur_stop_iter: int = 7000
    blur_window: Literal["any_view", "sum", "own_view"] = "any_view"
    blur_rule: Literal["by_scale", "split"] = "by_scale"
    revised_opacity: bool = False
    reset_every: int = 0
    reset_at_zero: bool = False
    reset_opa: float = 0.01


POP: Final = DensityConfig()
ADC: Final = DensityConfig(blur_start_iter=0, blur_stop_iter=-1, reset_every=3000)


def densifies_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the population is grown and pruned after this step (A17).

    `refine_start_iter < step < refine_stop_iter`, and step is a multiple of `refine_every`: 600, 700 ... 14900.

    Source: POP paper section 4.1 (every 100 iterations from 0.5K to 15K).
    Departs: nothing; both bounds are exclusive, as in Inria's and gsplat's code.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at an event.

    Example:
        >>> [step for step in range(0, 900, 50) if densifies_at(step, POP)]
        [600, 700, 800]
    """
    return config.refine_start_iter < step < config.refine_stop_iter and step % config.refine_every == 0


def blurs_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the blur rule takes part in an event of this step: both ends of its window included (A19).

    Source: POP paper section 4.1 (between 3K and 7K iterations).
    Departs: nothing.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True inside the blur window.

    Example:
        >>> [blurs_at(step, POP) for step in (2999, 3000, 7000, 7001)]
        [False, True, True, False]
    """
    return config.blur_start_iter <= step <= config.blur_stop_iter


def resets_at(step: int, config: DensityConfig) -> bool:
    """Tell whether opacities are reset after this step: never in POP (A22), 3000, 6000, 9000, 12000 in ADC.

    Source: POP paper section 3.1 (every 3,000 iterations).
    Departs: gsplat up to 1.5.2 resets at step 0 too (`reset_at_zero`, A25), and 1.5.3 by mistake never.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at a reset.

    Example:
        >>> [step for step in range(0, 16000, 1000) if resets_at(step, ADC)]
        [3000, 6000, 9000, 12000]
    """
    if config.reset_every == 0 or step >= config.refine_stop_iter or step % config.reset_every != 0:
        return False
    return step > 0 or config.reset_at_zero
