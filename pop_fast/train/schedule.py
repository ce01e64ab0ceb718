"""What depends on the step number: what a step does, how far steps go by themselves, Adam's updates, the view order.

`refining` gives the settings of a training that continues where another one has ended, on the Gaussians that there are.
Objective, colour bands and rates are those of the last step. The number of Gaussians stays: density control is at rest,
whatever the method. The rate of the positions begins at ten times its last value and decays to that again, because what
the Gaussians are trained among has changed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import torch
from torch import Tensor

from pop_fast.density.control import DensityControl
from pop_fast.density.protocol import ForeignStrategy
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import Phase, Updates
from pop_ref.settings import BETAS, PARAMETERS, LearningRates, UpdateRules


def updates_of(
    lr: LearningRates,
    scene_scale: float,
    max_steps: int,
    rules: UpdateRules | None = None,
    edits: Sequence[int] = (),
    restarts: Sequence[int] = (),
) -> Updates:
    """List the rates and the numbers of all updates of a run; see `pop_ref.optimizer`.

    Args:
        lr: the rates to begin with, and the decay of the second moments.
        max_steps: length of the run, over which the means' rate decays.
        rules: which parameters Adam moves at which step; None moves all at every step.
        edits: steps after which Gaussians are added or removed; those outside the run are left out.
        restarts: steps after which Adam begins anew, likewise.
    """
    rules = rules or UpdateRules()
    edits, restarts = ([step for step in given if 0 <= step < max_steps] for given in (edits, restarts))
    steps = torch.arange(max_steps, dtype=torch.float64)
    base = {**lr.by_parameter(), "means": lr.means * scene_scale}
    rates = torch.tensor([base[name] for name in PARAMETERS], dtype=torch.float64).repeat(max_steps, 1)
    rates *= _round_factor(steps, rules)[:, None]
    share = _share(steps, max_steps, rules)
    decaying = [PARAMETERS.index(name) for name in PARAMETERS if name != "opacities"]
    rates[:, decaying] *= (lr.others_decay**share)[:, None]
    rates[:, PARAMETERS.index("means")] = base["means"] * lr.means_decay**share
    moved = torch.ones((max_steps, len(PARAMETERS)), dtype=torch.bool)
    if rules.edits_replace_update:
        moved[[*edits, *restarts]] = False
    if rules.opacities_stop_iter >= 0:
        moved[rules.opacities_stop_iter :, PARAMETERS.index("opacities")] = False
    moved[:, PARAMETERS.index("shN")] &= steps.clamp(min=1.0) % rules.sh_rest_every == 0
    numbers = moved.cumsum(0)
    for step in sorted(set(restarts)):
        numbers[step + 1 :] -= numbers[step].clone()
    return Updates(rates, (numbers * moved).to(torch.int32), rules.sh_rest_every, (BETAS[0], lr.beta2))


def steady_updates(lr: Mapping[str, float], steps: int) -> Updates:
    """Move every parameter at every step, at rates that stay the same."""
    rates = torch.tensor([[lr[name] for name in PARAMETERS]], dtype=torch.float64).repeat(steps, 1)
    numbers = torch.arange(1, steps + 1, dtype=torch.int32)[:, None].repeat(1, len(PARAMETERS))
    return Updates(rates, numbers)


def _share(steps: Tensor, max_steps: int, rules: UpdateRules) -> Tensor:
    """Return how much of the means' decay is behind each step."""
    start = rules.rounds_start_iter
    if start > 0:
        in_rounds = start + (steps - start) % rules.round_steps + 1.0
        return torch.where(steps < start, steps / start, in_rounds / (start + rules.round_steps))
    at = steps
    if rules.means_rewind_iter > 0:
        back = rules.means_rewind_iter - rules.means_rewind_to
        at = torch.where(steps < rules.means_rewind_iter, steps, steps - back)
    return (at / max_steps).clamp_(0.0, 1.0)


def _round_factor(steps: Tensor, rules: UpdateRules) -> Tensor:
    """Return what a round of pruning and refining has multiplied the rates by."""
    start = rules.rounds_start_iter
    taken = (steps - start) % rules.round_steps + 1
    factor = rules.round_decay ** (taken // rules.round_decay_every)
    return torch.where((steps >= start) & (start > 0), factor, 1.0)


def active_sh_degree(step: int, interval: int, degree: int, start: int = 0) -> int:
    """Return the highest active colour band: from step `start` on one more every `interval` steps, from 0."""
    return min(max(step - start, 0) // interval, degree)


def phase_at(config: TrainConfig, strategy: DensityControl | ForeignStrategy, step: int) -> Phase:
    """Return what a step does; what a strategy of other people collects is not known, and it sees to that itself."""
    own = isinstance(strategy, DensityControl)
    return Phase(
        sh_degree=active_sh_degree(step, config.sh_interval, config.sh_degree, config.strategy.sh_start_iter),
        pop=own and strategy.lambda_pop != 0.0 and strategy.regularizes(step),
        statistics=own and strategy.collects(step),
        blur=own and strategy.collects_blur(step),
        objective=config.objective_at(step),
        window=own and strategy.collects_window(step),
        entropy=own and strategy.lambda_entropy != 0.0 and strategy.regularizes(step),
    )


def segment_end(config: TrainConfig, strategy: DensityControl | ForeignStrategy, first: int, longest: int) -> int:
    """Return how far a stepper goes by itself: to a densification step, a milestone, another phase, or far enough.

    Returns:
        One more than the last step of the segment.
    """
    phase, step = phase_at(config, strategy, first), first
    while True:
        if reads_rows(config, strategy, step + 1) or step + 1 - first == longest:
            return step + 1
        step += 1
        if phase_at(config, strategy, step) != phase:
            return step


def reads_rows(config: TrainConfig, strategy: DensityControl | ForeignStrategy, taken: int) -> bool:
    """Tell whether density control, a measurement or a file reads all Gaussians when so many steps have been taken."""
    return strategy.changes_after(taken - 1) or is_milestone(config, taken)


def is_milestone(config: TrainConfig, taken: int) -> bool:
    """Tell whether something is measured or written when so many steps have been taken."""
    due = config.checkpoint_every > 0 and taken % config.checkpoint_every == 0
    planned = (*config.eval_steps, *config.save_steps, config.strategy.blur_stop_iter, config.max_steps)
    return due or taken in planned


def updates_of_strategy(config: TrainConfig, strategy: DensityControl | ForeignStrategy, scene_scale: float) -> Updates:
    """List rates and numbers of all of Adam's updates of a run; of other people's strategy no edits are known."""
    if isinstance(strategy, ForeignStrategy):
        return updates_of(config.lr, scene_scale, config.max_steps)
    edits = [step for step in range(config.max_steps) if strategy.is_refine_step(step)]
    return updates_of(config.lr, scene_scale, config.max_steps, strategy, edits, strategy.adam_restarts)


class ViewOrder:
    """Draws views: every epoch is a fresh random permutation, so each view comes once an epoch.

    The generator is its own, so that nothing else that draws random numbers moves the order.
    """

    def __init__(self, n_views: int, seed: int) -> None:
        self._n = n_views
        self._generator = torch.Generator().manual_seed(seed)
        self._order: list[int] = []
        self._position = 0

    def next(self) -> int:
        """Return the index of the next view."""
        if self._position == len(self._order):
            self._order = torch.randperm(self._n, generator=self._generator).tolist()
            self._position = 0
        self._position += 1
        return self._order[self._position - 1]

    def ahead(self, count: int) -> list[int]:
        """Return the views to come, without drawing them."""
        copy = ViewOrder(self._n, 0)
        copy.load_state_dict(self.state_dict())
        return [copy.next() for _ in range(count)]

    def state_dict(self) -> dict[str, Any]:
        """Return all that decides the views to come."""
        return {"generator": self._generator.get_state(), "order": list(self._order), "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        self._generator.set_state(state["generator"])
        self._order = list(state["order"])
        self._position = int(state["position"])


# what the positions' rate begins at, over its last value
_MEANS_AGAIN: Final = 10.0


def refining(config: TrainConfig, steps: int) -> TrainConfig:
    """Return the settings of a training that continues after the last step of another one.

    Raises:
        PopError: the method, of another package, edits the Gaussians even at rest; names its class.
    """
    last, plan, lr = config.max_steps - 1, config.strategy, config.lr
    resting = plan.at_rest()
    edits = next((step for step in range(steps) if resting.changes_after(step)), None)
    if edits is not None:
        name = type(plan).__name__
        raise PopError(
            f"{name} would edit the Gaussians {edits + 1} steps after its training; give it a method at_rest"
        )
    degree = active_sh_degree(last, config.sh_interval, config.sh_degree, plan.sh_start_iter)
    # a curve ends one step after the last, but a round of pruning and refining at its last
    end = torch.tensor([last if plan.rounds_start_iter > 0 else config.max_steps], dtype=torch.float64)
    share, factor = float(_share(end, config.max_steps, plan)), float(_round_factor(end, plan))
    decay = lr.means_decay**share
    begins = min(_MEANS_AGAIN * decay, 1.0)
    ended = {
        name: factor * lr.others_decay**share * getattr(lr, name) for name in ("scales", "quats", "sh0", "sh_rest")
    }
    ended["opacities"] = factor * lr.opacities
    strategy = replace(
        resting,
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
        lr=replace(lr, **ended, others_decay=1.0, means=begins * lr.means, means_decay=decay / begins),
        eval_steps=(),
        save_steps=(),
        max_renders=0,
        coarse_stop_iters=(),
    )
