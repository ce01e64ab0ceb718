"""When the densification steps of density control happen.

Steps count from 0 as in gsplat: the densification step of step s follows the Adam update of step s. The numbers are in
`settings.DensityConfig`, which is re-exported here.
"""

from __future__ import annotations

from pop_ref.settings import GSPLAT, POP, DensityConfig

__all__ = ["GSPLAT", "POP", "DensityConfig", "blurs_at", "densifies_at", "resets_at"]


def densifies_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the Gaussians are grown and pruned after this step (A17).

    `refine_start_iter < step < refine_stop_iter`, and step is a multiple of `refine_every`: 600, 700 ... 14900; but not
    within `pause_refine_after_reset` steps of a reset.

    Source: POP paper section 4.1 (every 100 iterations from 0.5K to 15K).
    Departs: nothing; both bounds are exclusive, as in Inria's and gsplat's code.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at a densification step.

    Example:
        >>> [step for step in range(0, 900, 50) if densifies_at(step, POP)]
        [600, 700, 800]
    """
    if config.reset_every > 0 and step % config.reset_every < config.pause_refine_after_reset:
        return False
    return config.refine_start_iter < step < config.refine_stop_iter and step % config.refine_every == 0


def blurs_at(step: int, config: DensityConfig) -> bool:
    """Tell whether the blur rule takes part in densification after this step: both ends of its window included (A19).

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
    """Tell whether opacities are reset after this step: never in POP (A22), 3000, 6000, 9000, 12000 in gsplat.

    Source: POP paper section 3.1 (every 3,000 iterations).
    Departs: gsplat up to 1.5.2 resets at step 0 too (`reset_at_zero`, A25), and 1.5.3 by mistake never.

    Args:
        step: from 0.
        config: the schedule.

    Returns:
        True at a reset.

    Example:
        >>> [step for step in range(0, 16000, 1000) if resets_at(step, GSPLAT)]
        [3000, 6000, 9000, 12000]
    """
    if config.reset_every == 0 or step >= config.refine_stop_iter or step % config.reset_every != 0:
        return False
    return step > 0 or config.reset_at_zero
