"""Training steps over several views, drawn by one process or by several to the same bits.

The loss of a step is the mean over its views v of what a step of v alone would have, every view with its own render:

    L = 1/B sum_v [ (1 - lambda) L_pixel(v) + lambda (1 - SSIM(v)) + lambda_pop L_pop(opacities, dominant in v) ]

Density control sees the views of a step one after the other, in the order of the batch, as it would see those of B
steps with the same parameters: screen gradients are those of each view's own loss, a Gaussian that k views see counts k
times, `views` grows by B, dominated pixels are held against each view's own size for its blur set, and of these sets
the last, the union or the set of the sum is taken as `blur_window` says. What depends on dominated pixels of the window
(`pop_views="window"`) reads those before the step.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from pop_fast.density.control import DensityControl
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.model import adam_step
from pop_fast.train.ranks import Ranks
from pop_fast.train.steps import Phase, StepStats
from pop_fast.train.torch_stepper import TorchStepper, ViewGradient


class BatchStepper(TorchStepper):
    """Takes steps of `batch_size` views; see `TorchStepper`.

    The gradients of the views are added in the order of the batch and then divided by their number, whoever drew them.
    A process holds the gradients of its own views at a time; one that trains alone holds those of one.
    """

    def _take(self, step: int, phase: Phase) -> StepStats:
        task, ranks, size = self._task, self._task.ranks, self._task.config.batch_size
        indices = task.order[step * size : (step + 1) * size]
        looks: list[dict[str, Tensor]] = []
        numbers: list[Tensor] = []
        keys: list[str] = []

        def gradients() -> Iterator[Tensor]:
            for place in ranks.positions(size):
                look = self._look(indices[place], step, phase)
                looks.append(self._seen(look, step))
                numbers.append(_numbers(self._measured(look, step, phase), look.loss))
                keys[:] = [key for key, param in self._params.items() if param.grad is not None]
                yield self._flat_gradients(keys)

        with task.stop.abandoning(task.may_abandon):
            total = ranks.total(gradients()).div_(size)
            stats = self._agreed(ranks.gather(numbers), indices, step)
        self._give_gradients(keys, total)
        adam_step(self._params, self._optimizers, task.updates, step, self._state)
        self._collect(looks, indices, step)
        self.step = step + 1
        return stats

    def _seen(self, look: ViewGradient, step: int) -> dict[str, Tensor]:
        """Take from a view what density control will read of it."""
        strategy, info = self._strategy, look.rendered.info
        if not strategy.collects(step):
            return {}
        means2d = info[strategy.key_for_gradient]
        found = {"gradient": means2d.absgrad if strategy.absgrad else means2d.grad, "radii": info["radii"]}
        if strategy.collects_blur(step) or strategy.collects_window(step):
            found["dominant_counts"] = info["dominant_counts"].long()
        return found

    def _collect(self, looks: Sequence[dict[str, Tensor]], indices: Sequence[int], step: int) -> None:
        """Let density control look at all views of the batch, one after the other."""
        gathered = {name: self._task.ranks.gather([look[name] for look in looks]) for name in looks[0]}
        if not gathered:
            return
        strategy = self._strategy
        for place, index in enumerate(indices):
            view = self._task.views[index]
            found = {name: tensors[place] for name, tensors in gathered.items()}
            gradient = found.pop("gradient")
            info: dict[str, Any] = {**found, "width": view.width, "height": view.height, "n_cameras": 1}
            info[strategy.key_for_gradient] = SimpleNamespace(grad=gradient, absgrad=gradient)
            if view.mask is not None:
                info["kept_pixels"] = view.kept_pixels
            strategy.collect(self._params, self._state, step, info)

    @property
    def _strategy(self) -> DensityControl:
        strategy = self._task.strategy
        assert isinstance(strategy, DensityControl)
        return strategy

    def _flat_gradients(self, keys: Sequence[str]) -> Tensor:
        """Take the gradients away from the parameters, as one vector."""
        found = [self._params[key].grad for key in keys]
        for param in self._params.values():
            param.grad = None
        return torch.cat([gradient.reshape(-1) for gradient in found if gradient is not None])

    def _give_gradients(self, keys: Sequence[str], total: Tensor) -> None:
        parts = total.split([self._params[key].numel() for key in keys])
        for key, part in zip(keys, parts, strict=True):
            self._params[key].grad = part.view_as(self._params[key])

    def _agreed(self, numbers: Sequence[Tensor], indices: Sequence[int], step: int) -> StepStats:
        """Return the means of the views' measurements.

        Raises:
            ValueError: the loss of a view is not finite; every process says so of the same view.
        """
        rows = [row.tolist() for row in numbers]
        for index, row in zip(indices, rows, strict=True):
            if not math.isfinite(row[-1]):
                raise ValueError(f"the loss of view {self._task.views[index].name} is {row[-1]} at step {step}")
        return StepStats(*(sum(column) / len(rows) for column in list(zip(*rows, strict=True))[:-1]))


def _numbers(stats: StepStats, loss: Tensor) -> Tensor:
    return torch.tensor([*stats, loss.item()], dtype=torch.float64)


def check_batch(config: TrainConfig, own_strategy: bool, ranks: Ranks) -> None:
    """Check that the views of a step can be shared out.

    Args:
        config: `batch_size` is read.
        own_strategy: whether the density strategy is one of this package.
        ranks: the processes that draw them.

    Raises:
        PopError: they cannot; says what to change.
    """
    size = config.batch_size
    if size % ranks.size:
        raise PopError(
            f"batch_size is {size}; {ranks.size} processes share the views of a step evenly: "
            f"use --batch-size {ranks.size} or a multiple of it"
        )
    learned = [name for name in ("exposure", "refine_cameras") if getattr(config, name)]
    if size > 1 and learned:
        option = learned[0].replace("_", "-")
        raise PopError(
            f"batch_size is {size}; what --{option} learns of a photograph needs steps of one view: "
            f"leave out --batch-size, or --{option}"
        )
    if size > 1 and not own_strategy:
        raise PopError(
            f"batch_size is {size}; it must be 1 with a strategy of somebody else, which looks at one render a step"
        )
