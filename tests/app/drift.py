"""Something that takes whole steps without being a training step: numbers drift, deterministically, by what they are.

It follows the interface of `cuda_ext.training.train_step.FusedTrainer` on the CPU and shows what the run does around
such steps: segments, densification steps, statistics, checkpoints, errors. What real steps compute is shown by real
steppers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from pop_fast.api.backend import get_backend
from pop_fast.train.stepper import Engine, FusedStepper
from pop_fast.train.steps import Collected, Phase, StepSettings, StepStats
from pop_fast.train.views import ViewTensors
from pop_ref.settings import PARAMETERS

# steps at a time, as on a GPU
MOST = 500
Rows = Mapping[str, Tensor]


class Drift:
    """See `cuda_ext.training.train_step.FusedTrainer`; tests may set `before_step`, called with the step's number."""

    def __init__(
        self,
        params: Rows,
        m: Rows,
        v: Rows,
        views: Sequence[ViewTensors],
        order: Sequence[int],
        settings: StepSettings,
        step: int,
    ) -> None:
        assert len(order) == len(settings.updates.rates)
        self.views, self.order, self.settings, self.step = views, order, settings, step
        self.grown = 0
        self.runs: list[tuple[int, int, Phase]] = []
        self._stats: dict[int, StepStats] = {}
        self.rebind(params, m, v)

    def rebind(self, params: Rows, m: Rows, v: Rows) -> None:
        self.params, self.m, self.v = dict(params), dict(m), dict(v)
        self.statistics = Collected.zeros(len(params["means"]), params["means"].device)

    def run(self, until: int, phase: Phase) -> None:
        self.runs.append((self.step, until, phase))
        while self.step < until:
            self.before_step(self.step)
            for rows in self.params.values():
                if not bool(torch.isfinite(rows).all()):
                    raise ValueError(f"step {self.step}: a Gaussian has a value that is not finite")
            self._stats[self.step] = self._one(self.order[self.step], phase)
            self.step += 1

    def step_stats(self, first: int, last: int) -> list[StepStats]:
        return [self._stats[step] for step in range(first, last)]

    def synchronize(self) -> None:
        """Nothing: there is one process."""

    def facts(self) -> dict[str, int]:
        return {"instance_buffers_grown": self.grown}

    def before_step(self, step: int) -> None:
        """Nothing; for tests."""

    def _one(self, view: int, phase: Phase) -> StepStats:
        rates = dict(zip(PARAMETERS, self.settings.updates.rates[self.step].tolist(), strict=True))
        found, shift = self.statistics, torch.cos(self.params["means"].sum(1) + view)
        for name, rows in self.params.items():
            step = shift.reshape(-1, *[1] * (rows.dim() - 1))
            self.m[name].mul_(0.9).add_(0.1 * step)
            self.v[name].mul_(0.9).add_(0.1 * step * step)
            rows.add_(rates[name] * self.m[name] / (self.v[name].sqrt() + 1.0))
        if phase.statistics:
            found.grad_sum.add_(0.02 * shift.abs())
            found.n_visible.add_((shift > -0.5).int())
        counts = (20.0 * shift.clamp_min(0.0)).int()
        if phase.blur or phase.window:
            found.dominant_sum.add_(counts)
        if phase.blur:
            blurred = counts > self.settings.blur_pixels(self.views[view].kept_pixels)
            found.blurred.copy_(blurred if self.settings.blur_window == "own_view" else found.blurred.bool() | blurred)
        loss = float(shift.square().mean())
        return StepStats(loss, 0.5, loss, loss, 0.25 if phase.pop else 0.0)


def drift_engine() -> Engine:
    facts = {"gpu": "drift", "gpu_memory_bytes": 0}
    return Engine(
        "cuda",
        torch.device("cpu"),
        get_backend("fast"),
        lambda task: FusedStepper(task, "cuda", MOST, Drift),
        lambda: facts,
    )
