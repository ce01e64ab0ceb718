"""What takes the steps of a training run, on any engine; `TrainingRun` does all the rest.

`FusedStepper` has them taken by something that takes a whole step by itself: the fused step on a GPU, or one like it.
That is given rows, the photographs and `StepSettings`; it holds the statistics of density control in its own arrays,
which are copied into the strategy's state after every segment, in the strategy's own types.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.api.backend import Renderer
from pop_fast.density.control import DensityControl
from pop_fast.density.protocol import ForeignStrategy, State
from pop_fast.stages.density import blur_set
from pop_fast.train.appearance import Appearance
from pop_fast.train.checkpoint import on_cpu, pack_optimizers
from pop_fast.train.config import TrainConfig
from pop_fast.train.model import KEYS, MOMENTS
from pop_fast.train.ranks import ALONE, Ranks
from pop_fast.train.signals import StopRequest
from pop_fast.train.steps import Collected, Phase, StepSettings, StepStats, Updates
from pop_fast.train.views import ViewTensors


class Stepper(Protocol):
    """Takes training steps: render, objective, backward pass, Adam, the statistics of density control.

    It works on what it is bound to: after `steps` the parameters, the optimizers' state and the strategy's statistics
    in `state` are those of the last step; where several processes train together, after `synchronize`. What shares the
    Gaussians out keeps the optimizers' moments itself, and between several processes colours too; see `OwnRows`.
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

        They are fewer where a stop was requested: `step` then tells how many, and nothing is changed by the
        one that was left.

        Raises:
            ValueError: a number is no longer finite; `step` tells at which step, which has not changed the parameters.
        """
        ...

    def synchronize(self) -> None:
        """Take over what other processes moved and counted since the last time; all of them do so together."""
        ...

    def gather(self, everywhere: bool = False) -> None:
        """Put all Gaussians' rows into parameters that processes keep of their own alone, until the next steps.

        Processes that train together call it together, after a `synchronize`.

        Args:
            everywhere: at every process; otherwise at the one that writes, and the others' stay as they are.
        """
        ...

    def moments(self) -> dict[str, dict[str, Tensor]]:
        """Return Adam's moments and counters by parameter on the CPU, as a checkpoint holds them.

        Processes that train together call it together. The moments are those of all Gaussians at the process that
        writes, and perhaps nobody's at the others.
        """
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
    stop: StopRequest = field(default_factory=StopRequest)  # whether a stop was requested
    scene_scale: float = 1.0  # by which depth is compared, world units

    @property
    def may_abandon(self) -> bool:
        """Tell whether a step may be left half way: not where other processes or a third-party strategy take part."""
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


Rows = Mapping[str, Tensor]
# s, after which a block of steps should be done, so that its progress is seen
BLOCK_SECONDS: Final = 1.0


class Fused(Protocol):
    """What takes whole steps: `cuda_ext.training.train_step.FusedTrainer`, where each of these is explained."""

    step: int

    @property
    def statistics(self) -> Any:
        """What density control reads: `Collected`, or what has its attributes."""
        ...

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        """Take new rows after a density step; statistics start from nothing."""
        ...

    def run(self, until: int, phase: Phase) -> None:
        """Take steps of one phase until the counter stands at `until`, or until a stop was requested."""
        ...

    def step_stats(self, first: int, last: int) -> Sequence[Sequence[float]]:
        """Return the measurements of the steps from `first` to before `last`, in the order of `StepStats`."""
        ...

    def synchronize(self) -> None:
        """Take over the rows, moments and statistics that other processes moved since the last time."""
        ...

    def facts(self) -> dict[str, int]:
        """Return what the statistics of a run tell of the device."""
        ...


@runtime_checkable
class OwnRows(Protocol):
    """A `Fused` that keeps the moments of its own Gaussians itself, where processes share the Gaussians out.

    In place of their moments the optimizers hold, under `ORIGINS` and from `synchronize` to the next `rebind`, a number
    for each row: its place, from 1, which stays with the row when others are removed; 0 is a row without moments.

    It may also keep parameters of its own Gaussians alone. Their `Parameter` is empty while steps are taken, and holds
    such numbers after `synchronize`, which a copy has from its source.
    """

    apart: tuple[str, ...]  # parameters that it keeps of its own Gaussians alone

    def regroup(self, params: Rows, origins: Rows) -> None:
        """Take new rows after a density step, as `Fused.rebind`; moments go to those that own the rows now.

        Args:
            params: of those that are kept `apart` all rows, or from which former place, from 1, each is copied. [N]
            origins: for each parameter the former place of each row, from 1, or 0 for moments of zero. int32 [N]
        """
        ...

    def moments(self) -> dict[str, dict[str, Tensor]]:
        """Return the moments of all Gaussians by parameter and torch's names, on the CPU, at the process that writes.

        All processes call it together; the others get empty tensors.
        """
        ...

    def whole(self, everywhere: bool) -> Rows:
        """Return all rows of the parameters that are kept `apart`, at every process or at the one that writes.

        All processes call it together; those without the rows get an empty dict.
        """
        ...


# the rows of an optimizer's parameter before a density step, in its state
ORIGINS: Final = "origins"
# parameters, first and second moments, the views, the view of every step, settings, the step to begin at
MakeFused = Callable[[Rows, Rows, Rows, Sequence[ViewTensors], Sequence[int], StepSettings, int], Fused]


@dataclass
class FusedStepper:
    """Takes steps by `make`, of `batch_size` views where that knows them, at most `most` at a time; see `Stepper`."""

    task: Task
    name: str
    most: int
    make: MakeFused
    fused: Fused | None = None

    def __post_init__(self) -> None:
        self.step, self._views = self.task.step, self.task.config.batch_size
        # of the last steps, a pixel
        self._seconds: float | None = None
        self._optimizers: Mapping[str, Adam] = {}
        self._params: dict[str, Parameter] = {}
        self._state: State = {}
        # the last step taken and its phase, while what was collected is not in the strategy's state
        self._collected: tuple[int, Phase] | None = None

    def rebind(self, params: dict[str, Parameter], optimizers: Mapping[str, Adam], state: State) -> None:
        self._params, self._optimizers, self._state = params, optimizers, state
        rows, of_adam = {key: params[key].detach() for key in KEYS}, self._of_adam()
        if isinstance(self.fused, OwnRows):
            self.fused.regroup(rows, {key: of_adam[key].pop(ORIGINS) for key in KEYS})
        else:
            moments = [{key: of_adam[key][name] for key in KEYS} for name in MOMENTS]
            if self.fused is None:
                self.fused = self._made(rows, *moments)
            else:
                self.fused.rebind(rows, *moments)
        self._give_statistics(self.fused.statistics)

    def _of_adam(self) -> dict[str, dict[str, Tensor]]:
        """Return what the optimizers hold, by parameter."""
        return {key: self._optimizers[key].state[self._params[key]] for key in KEYS}

    def _made(self, rows: Rows, m: Rows, v: Rows) -> Fused:
        task = self.task
        settings = step_settings(task.config, task.updates, task.scene_scale)
        fused = self.make(rows, m, v, task.views, task.order, settings, self.step)
        if isinstance(fused, OwnRows):
            for found in self._of_adam().values():
                for name in MOMENTS:
                    del found[name]
        return fused

    @property
    def longest(self) -> int:
        """See `Stepper.longest`: as many as take about a second, if a pixel takes what it took last; one at least."""
        if self._seconds is None:
            return 1
        seconds = 0.0
        for count in range(min(self.most, len(self.task.order) // self._views - self.step)):
            seconds += self._seconds * self._pixels(self.step + count, self.step + count + 1)
            if seconds > BLOCK_SECONDS:
                return max(count, 1)
        return self.most

    def _pixels(self, first: int, last: int) -> int:
        """Return how many pixels the views of some steps have."""
        views = [self.task.views[index] for index in self.task.order[first * self._views : last * self._views]]
        return sum(view.height * view.width for view in views)

    def steps(self, first: int, last: int, phase: Phase) -> list[StepStats]:
        assert self.fused is not None
        if self._collected is not None and self._collected[1] != phase:
            self.synchronize()
        self._leave_to_owners()
        start = time.perf_counter()
        try:
            self.fused.run(last, phase)
        finally:
            self.step = last = self.fused.step
        if last <= first:
            return []
        self._collected = last, phase
        if phase.statistics:
            self._state["views"] += (last - first) * self._views
        if self.task.ranks.size == 1:
            self.synchronize()
        took = torch.tensor([time.perf_counter() - start], dtype=torch.float64)
        # processes that train together agree on how many steps come next
        took = max(float(one) for one in self.task.ranks.gather([took]))
        self._seconds = took / max(self._pixels(first, last), 1)
        numbers = self.task.updates.numbers[first:last].amax(0).tolist()
        for key, number in zip(KEYS, numbers, strict=True):
            if number > 0:
                self._optimizers[key].state[self._params[key]]["step"].fill_(float(number))
        return [StepStats(*row) for row in self.fused.step_stats(first, last)]

    def synchronize(self) -> None:
        if self.fused is not None and self._collected is not None:
            self.fused.synchronize()
            self._take_statistics(self.fused.statistics, *self._collected)
            self._collected = None
        if isinstance(self.fused, OwnRows):
            means = self._params["means"]
            # of a type that a parameter may have, and exact up to 2^53
            places = torch.arange(1, len(means) + 1, dtype=torch.float64, device=means.device)
            for found in self._of_adam().values():
                found[ORIGINS] = places.int()
            for key in self.fused.apart:
                self._params[key].data = places.clone()

    def gather(self, everywhere: bool = False) -> None:
        if isinstance(self.fused, OwnRows):
            for key, rows in self.fused.whole(everywhere).items():
                self._params[key].data = rows

    def _leave_to_owners(self) -> None:
        """Let go of the rows of parameters that are kept apart, and of the numbers of rows."""
        if isinstance(self.fused, OwnRows):
            for found in self._of_adam().values():
                found.pop(ORIGINS, None)
            for key in self.fused.apart:
                self._params[key].data = torch.empty(0, device=self._params[key].device)

    def moments(self) -> dict[str, dict[str, Tensor]]:
        packed = pack_optimizers(self._optimizers)
        if isinstance(self.fused, OwnRows):
            packed = {key: {"step": packed[key]["step"], **found} for key, found in self.fused.moments().items()}
        return on_cpu(packed)

    def facts(self) -> dict[str, Any]:
        return {} if self.fused is None else dict(self.fused.facts())

    def _take_statistics(self, found: Collected, last: int, phase: Phase) -> None:
        """Copy what was collected into the strategy's state."""
        state, pop = self._state, self.task.config.strategy
        if phase.statistics:
            state["grad2d"], state["count"] = found.grad_sum.clone(), found.n_visible.to(found.grad_sum.dtype)
        if found.sh_rest_sum is not None:
            state["sh_rest_sum"] = found.sh_rest_sum.clone()
        summed = phase.blur and pop.blur_window == "sum"
        if summed or phase.window:
            state["dominant_sum"] = found.dominant_sum.long()
        if not phase.blur:
            return
        if summed:
            view = self.task.views[self.task.order[last * self._views - 1]]
            bound = (view.width, view.height, pop.theta_blur, pop.blur_min_pixels, view.kept_pixels)
            state["blurred"] = blur_set(state["dominant_sum"], *bound)
        else:
            state["blurred"] = found.blurred.bool()

    def _give_statistics(self, found: Collected) -> None:
        """Go on from the strategy's state: after a checkpoint, or a change that kept the window."""
        given = {"grad2d": found.grad_sum, "count": found.n_visible, "dominant_sum": found.dominant_sum}
        for key, target in {**given, "blurred": found.blurred, "sh_rest_sum": found.sh_rest_sum}.items():
            if target is not None and self._state.get(key) is not None:
                target.copy_(self._state[key])


def step_settings(config: TrainConfig, updates: Updates, scene_scale: float = 1.0) -> StepSettings:
    """Return what stays the same over a run.

    Args:
        scene_scale: world units.
    """
    of_strategy = ("lambda_pop", "lambda_entropy", "pop_views", "pop_over")
    of_strategy += ("blur_window", "theta_blur", "blur_min_pixels")
    return StepSettings(
        updates,
        padding=config.ssim_padding,
        depth_weight=config.depth_lambda * scene_scale,
        profile=config.renderer,
        **{name: getattr(config.strategy, name) for name in of_strategy},
        **{name: getattr(config, name) for name in ("opacity_reg", "scale_reg", "background", "antialiased")},
    )
