"""What the settings of a run mean to a trainer that lets the device take many steps at a time."""

from __future__ import annotations

from cuda_ext.train_settings import Phase, StepSettings
from pop_fast.train.config import TrainConfig
from pop_fast.train.schedule import active_sh_degree
from pop_ref.constants import PROFILES

# so many steps at most before the host looks up: Ctrl-C, the progress bar
LONGEST = 500


def unsupported(config: TrainConfig) -> str | None:
    """Return one sentence on a setting that the fused step does not know and what to do, or None."""
    plan, method = config.strategy, config.method
    known = {
        "absgrad": (plan.absgrad, False),
        "key_for_gradient": (plan.key_for_gradient, "means2d"),
        "refine_scale2d_stop_iter": (plan.refine_scale2d_stop_iter, 0),
    }
    for name, (value, supported) in known.items():
        if value != supported:
            return (
                f"backend 'cuda' trains with {method}.{name} = {supported!r} only, not {value!r}; "
                f"use --backend fast, or leave {method}.{name} as it is"
            )
    return None


def step_settings(config: TrainConfig, scene_scale: float) -> StepSettings:
    """Return what stays the same over a run.

    Args:
        config: step numbers as they are run.
        scene_scale: the unit of the means' learning rate.
    """
    lr, pop = config.lr, config.strategy
    return StepSettings(
        {**lr.by_parameter(), "means": lr.means * scene_scale},
        config.max_steps,
        means_decay=lr.means_decay,
        padding=config.ssim_padding,
        d_ssim_halved=config.d_ssim_halved,
        pixelwise_scale=1.0 / config.photometric_divisor,
        lambda_pop=pop.lambda_pop,
        pop_views=pop.pop_views,
        pop_over=pop.pop_over,
        blur_window=pop.blur_window,
        theta_blur=pop.theta_blur,
        blur_min_pixels=pop.blur_min_pixels,
        background=config.background,
        profile=PROFILES[config.profile],
        antialiased=config.antialiased,
    )


def phase_at(config: TrainConfig, step: int) -> Phase:
    """Return what the step does."""
    plan = config.strategy
    collects = step < plan.refine_stop_iter
    pulls = plan.lambda_pop != 0.0 and plan.pop_start_iter <= step < plan.pop_stop_iter
    kind, weight = config.photometric_at(step)
    return Phase(
        sh_degree=active_sh_degree(step, config.sh_interval, config.sh_degree),
        pop=pulls,
        statistics=collects,
        blur=collects and step <= plan.blur_stop_iter,
        l1=kind == "l1",
        lambda_ssim=weight,
        window=collects and plan.pop_views == "window",
    )


def changes_after(config: TrainConfig, step: int) -> bool:
    """Tell whether density control edits the Gaussians after the step."""
    plan = config.strategy
    return step < plan.refine_stop_iter and (plan.is_refine_step(step) or plan.is_reset_step(step))


def stretch_end(config: TrainConfig, first: int) -> int:
    """Return how far the device goes by itself: to an event, a milestone, another phase, or far enough."""
    phase, step = phase_at(config, first), first
    while True:
        if changes_after(config, step) or _is_milestone(config, step + 1) or step + 1 - first == LONGEST:
            return step + 1
        step += 1
        if phase_at(config, step) != phase:
            return step


def _is_milestone(config: TrainConfig, taken: int) -> bool:
    due = config.checkpoint_every > 0 and taken % config.checkpoint_every == 0
    planned = (*config.eval_steps, *config.save_steps, config.strategy.blur_stop_iter, config.max_steps)
    return due or taken in planned
