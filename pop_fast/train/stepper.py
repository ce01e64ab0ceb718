"""What takes the steps of a training run, on any engine; `TrainingRun` does all the rest."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.api.backend import Renderer
from pop_fast.density.control import DensityControl
from pop_fast.density.protocol import ForeignStrategy, State
from pop_fast.train.appearance import Appearance
from pop_fast.train.config import TrainConfig
from pop_fast.train.ranks import ALONE, Ranks
from pop_fast.train.signals import StopRequest
from pop_fast.train.steps import Phase, StepStats, Updates
from pop_fast.train.views import ViewTensors


class Stepper(Protocol):
    """Takes training steps: render, objective, backward pass, Adam, the statistics of density control.

    It works on what it is bound to and owns nothing that a checkpoint needs: after `steps` the parameters, the
    optimizers' state and the strategy's statistics in `state` are those of the last step; where several processes train
    together, after `synchronize`.
    """

    name: str  # of the engine, for the statistics of a run
    step: int  # steps taken

    @property
    def longest(self) -> int:
        """Return how many steps `steps` is asked for at most, so that a run's progress is seen every second or so."""
        ...

    def rebind(self, params: dict[str, Parameter], optimizers: Mapping[str, Adam], state: State) -> None:
        """Go on with these rows, moments and statistics: at the beginning, and after the Gaussians have changed."""
        ...

    def steps(self, first: int, last: int, phase: Phase) -> list[StepStats]:
        """Take the steps from `first` to before `last`, all of one phase, and return each one's measurements.

        They are fewer where somebody has asked for an end: `step` then tells how many, and nothing is changed by the
        one that was left.

        Raises:
            ValueError: a number is no longer finite; `step` tells at which step, which has not changed the parameters.
        """
        ...

    def synchronize(self) -> None:
        """Take over what other processes moved and counted since the last time; all of them do so together."""
        ...

    def facts(self) -> dict[str, Any]:
        """Return what goes into the statistics of a run."""
        ...


@dataclass(frozen=True)
class Task:
    """What a stepper is to train."""

    config: TrainConfig  # step numbers as they are run
    strategy: DensityControl | ForeignStrategy  # the one of density control
    views: Sequence[ViewTensors]  # to train on
    order: Sequence[int]  # the views of every step, `config.batch_size` of them a step
    updates: Updates  # which parameters Adam moves at which step
    step: int  # steps taken
    appearance: Appearance  # what is learned of the photographs
    ranks: Ranks = ALONE  # the processes that draw the views of a step
    stop: StopRequest = field(default_factory=StopRequest)  # whether somebody has asked for an end
    scene_scale: float = 1.0  # by which depth is compared, world units

    @property
    def may_abandon(self) -> bool:
        """Tell whether a step may be left half way: not where other processes or somebody else's strategy take part."""
        return self.ranks.size == 1 and isinstance(self.strategy, DensityControl)


@dataclass(frozen=True)
class Engine:
    """Where and by what a run is done."""

    name: str  # that settings give it, under which a run is resumed
    device: torch.device  # holds parameters, moments and statistics
    backend: Renderer  # renders there for measurements, from and to the CPU
    make_stepper: Callable[[Task], Stepper]  # makes what takes the steps
    facts: Callable[[], dict[str, Any]] = dict  # goes into the statistics of a run
    # whether another number of threads may round otherwise; if not, a run is resumed with any
    depends_on_threads: bool = True
