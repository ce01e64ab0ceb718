"""What each step of a run does, and how far steps go before the run itself has something to do."""

from __future__ import annotations

from cuda_ext.train_settings import Phase, Updates
from pop_fast.density.control import DensityControl
from pop_fast.density.foreign import ForeignStrategy
from pop_fast.train.config import TrainConfig
from pop_fast.train.schedule import active_sh_degree, updates_of


def phase_at(config: TrainConfig, strategy: DensityControl | ForeignStrategy, step: int) -> Phase:
    """Return what a step does.

    Args:
        config: step numbers as they are run.
        strategy: decides what is collected; of one that is not ours it is not known, and it sees to that itself.
        step: counts from 0.
    """
    kind, weight = config.photometric_at(step)
    own = isinstance(strategy, DensityControl)
    return Phase(
        sh_degree=active_sh_degree(step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter),
        pop=own and strategy.lambda_pop != 0.0 and strategy.regularizes(step),
        statistics=own and strategy.collects(step),
        blur=own and strategy.collects_blur(step),
        l1=kind == "l1",
        lambda_ssim=weight,
        window=own and strategy.collects_window(step),
        entropy=own and strategy.lambda_entropy != 0.0 and strategy.regularizes(step),
    )


def segment_end(config: TrainConfig, strategy: DensityControl | ForeignStrategy, first: int, longest: int) -> int:
    """Return how far a stepper goes by itself: to a densification step, a milestone, another phase, or far enough.

    Args:
        config: step numbers as they are run.
        strategy: as in `phase_at`.
        first: the step to begin with.
        longest: most steps at a time.

    Returns:
        One more than the last step of the segment.
    """
    phase, step = phase_at(config, strategy, first), first
    while True:
        if strategy.changes_after(step) or is_milestone(config, step + 1) or step + 1 - first == longest:
            return step + 1
        step += 1
        if phase_at(config, strategy, step) != phase:
            return step


def is_milestone(config: TrainConfig, taken: int) -> bool:
    """Tell whether something is measured or written when so many steps have been taken."""
    due = config.checkpoint_every > 0 and taken % config.checkpoint_every == 0
    planned = (*config.eval_steps, *config.save_steps, config.strategy.blur_stop_iter, config.max_steps)
    return due or taken in planned


def updates_of_strategy(config: TrainConfig, strategy: DensityControl | ForeignStrategy, scene_scale: float) -> Updates:
    """List the rates and the numbers of all of Adam's updates of a run.

    Args:
        config: step numbers as they are run.
        strategy: at whose changes Adam may skip or restart; of one that is not ours it is not known.
        scene_scale: the unit of the means' rate, world units.
    """
    if isinstance(strategy, ForeignStrategy):
        return updates_of(config.lr, scene_scale, config.max_steps)
    edits = [step for step in range(config.max_steps) if strategy.is_refine_step(step)]
    return updates_of(config.lr, scene_scale, config.max_steps, strategy, edits, strategy.adam_restarts)
