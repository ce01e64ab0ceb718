"""Settings of a training that continues where another one has ended, on the Gaussians that there are.

Objective, colour bands and rates are those of the last step. The number of Gaussians stays: density control is at rest,
whatever the method. The rate of the positions begins at ten times its last value and decays to that again, because what
the Gaussians are trained among has changed.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Final

from pop_fast.density import DensityControl
from pop_fast.train.config import TrainConfig
from pop_fast.train.schedule import active_sh_degree

__all__ = ["at_rest", "refining"]

# what the positions' rate begins at, over its last value
_MEANS_AGAIN: Final = 10.0
# settings of every method that time a change of the Gaussians or of the schedule, and what each is when there is none
_NEVER: Final[dict[str, Any]] = {
    "refine_stop_iter": 0,
    "reset_every": 0,
    "reset_at_zero": False,
    "final_prune_iter": -1,
    "blur_start_iter": 0,
    "blur_stop_iter": -1,
    "refine_scale2d_stop_iter": 0,
    "means_rewind_iter": 0,
    "rounds_start_iter": 0,
    "prune_shares": (),
    "reinit_iters": (),
    "sample_iter": -1,
    "prune_iter": -1,
    "soft_prune_iters": (),
    "hard_prune_iters": (),
}


def at_rest(strategy: DensityControl) -> DensityControl:
    """Return the strategy of a method with every change of the Gaussians left out."""
    own = {field.name for field in fields(strategy)}
    return replace(strategy, **{name: value for name, value in _NEVER.items() if name in own})


def refining(config: TrainConfig, steps: int) -> TrainConfig:
    """Return the settings of a training that continues after the last step of another one.

    Args:
        config: of that training.
        steps: how many more are taken.
    """
    last, plan, lr = config.max_steps - 1, config.strategy, config.lr
    degree = active_sh_degree(last, config.sh_interval, config.sh_degree, plan.sh_start_iter)
    begins = min(_MEANS_AGAIN * lr.means_decay, 1.0)
    ended = {name: lr.others_decay * getattr(lr, name) for name in ("scales", "quats", "sh0", "sh_rest")}
    strategy = replace(
        at_rest(plan),
        # bands open at regular steps, which are counted from a past in which those in use have opened
        sh_start_iter=-degree * steps,
        pop_start_iter=0,
        pop_stop_iter=steps if plan.regularizes(last) else 0,
        opacities_stop_iter=0 if 0 <= plan.opacities_stop_iter <= last else -1,
    )
    return replace(
        config,
        given=None,
        max_steps=steps,
        strategy=strategy,
        sh_interval=steps,
        l2_stop_iter=0 if config.l2_stop_iter is not None and last >= config.l2_stop_iter else None,
        lr=replace(lr, **ended, others_decay=1.0, means=begins * lr.means, means_decay=lr.means_decay / begins),
        eval_steps=(),
        save_steps=(),
        max_renders=0,
        coarse_stop_iters=(),
    )
