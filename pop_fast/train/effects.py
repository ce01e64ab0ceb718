"""What the settings of a run come to on the photographs of a capture, and what will not do in that."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from pop_fast.train.config import TrainConfig
from pop_fast.train.views import ViewTensors
from pop_ref.settings import GSPLAT

# theta_blur is about so many pixels in the smallest images of the paper (10.7 in 980 x 545, its section 4.1)
ENOUGH_PIXELS: Final = 10
# densification steps between two resets in 3DGS and in gsplat's default strategy: 3,000 steps, one each 100
RECOVERY_EVENTS: Final = GSPLAT.reset_every // GSPLAT.refine_every


def facts(config: TrainConfig, views: Sequence[ViewTensors]) -> dict[str, Any]:
    """Return what a run's statistics say of its settings.

    Args:
        config: the settings.
        views: the training views.

    Returns:
        method, preset, seed, lambda_pop, theta_blur_pixels (share of the smallest and of the largest view, px),
        blur_min_pixels (px), blur_events (densification steps that look at blur).
    """
    plan = config.strategy
    sizes = [view.kept_pixels for view in views]
    return {
        "method": config.method,
        "preset": config.preset,
        "seed": config.seed,
        "lambda_pop": plan.lambda_pop,
        "theta_blur_pixels": [plan.theta_blur * min(sizes), plan.theta_blur * max(sizes)],
        "blur_min_pixels": plan.blur_min_pixels,
        "blur_events": sum(plan.is_blur_step(step) for step in _density_steps(config, plan.refine_every)),
    }


def find_warnings(config: TrainConfig, views: Sequence[ViewTensors]) -> Iterator[str]:
    """Say, in one sentence each, what will not do as it is set, and which option mends it.

    Args:
        config: the settings.
        views: the training views.
    """
    plan = config.strategy
    smallest = min(views, key=lambda view: view.kept_pixels)
    pixels = plan.theta_blur * smallest.kept_pixels
    blurs = any(plan.is_blur_step(step) for step in _density_steps(config, plan.refine_every))
    if blurs and max(pixels, plan.blur_min_pixels) < ENOUGH_PIXELS:
        yield (
            f"theta_blur is {pixels:.1f} pixels of {smallest.name} ({smallest.width} x {smallest.height}), where the "
            "paper's smallest images make it 10.7: nearly every Gaussian that is seen will count as blur and grow; "
            f"--{config.method}.blur-min-pixels {ENOUGH_PIXELS} mends it"
        )
    resets = [step for step in _density_steps(config, plan.reset_every) if plan.is_reset_step(step)]
    left = [after - step for step, after in zip(resets, [*resets[1:], config.max_steps], strict=False)]
    if resets and min(left) < RECOVERY_EVENTS * plan.refine_every:
        step = resets[left.index(min(left))]
        yield (
            f"opacities are reset after step {step:,} and have {min(left):,} steps ({min(left) // plan.refine_every} "
            f"densification steps) to recover, where 3DGS has {RECOVERY_EVENTS} densification steps; "
            f"--{config.method}.reset-every 0 leaves resets out"
        )


def _density_steps(config: TrainConfig, every: int) -> range:
    return range(0, min(config.max_steps, config.strategy.refine_stop_iter) if every > 0 else 0, every or 1)
