"""Training that holds some Gaussians fixed: whatever takes the steps, their rows are put back after each one.

An engine moves all rows. What it did to fixed ones is undone before the next step, so that every step draws the very
bits that were given, and their moments, which say how a row would be moved, move nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Adam

from pop_fast.density.protocol import State
from pop_fast.errors import PopError
from pop_fast.train.stepper import Engine, Stepper
from pop_fast.train.steps import Phase, StepStats

__all__ = ["HoldingStepper", "hold_last"]


def hold_last(engine: Engine, rows: Mapping[str, Tensor]) -> Engine:
    """Return an engine that keeps the last rows of the parameters as they are.

    Args:
        engine: takes the steps.
        rows: raw parameters of these Gaussians, which the parameters of the run must end with; they are not copied.
            The run's strategy must not change the number of Gaussians.
    """
    return replace(engine, make_stepper=lambda task: HoldingStepper(engine.make_stepper(task), rows))


class HoldingStepper:
    """Takes steps by another stepper, one at a time, and puts fixed rows back after each; see `Stepper`.

    Args:
        stepper: takes them.
        rows: raw parameters of the Gaussians that are held, the last ones of those that are trained.
    """

    def __init__(self, stepper: Stepper, rows: Mapping[str, Tensor]) -> None:
        self.name, self.step = stepper.name, stepper.step
        self._stepper, self._rows = stepper, dict(rows)
        self._places: dict[str, Tensor] = {}

    @property
    def longest(self) -> int:
        """See `Stepper.longest`."""
        return self._stepper.longest

    def rebind(self, params: dict[str, Parameter], optimizers: Mapping[str, Adam], state: State) -> None:
        """See `Stepper.rebind`.

        Raises:
            PopError: the parameters do not end with the rows that are held.
        """
        self._places = {key: params[key].detach()[len(params[key]) - len(self._rows[key]) :] for key in self._rows}
        self._rows = {key: rows.to(self._places[key].device) for key, rows in self._rows.items()}
        for key, place in self._places.items():
            if not torch.equal(place, self._rows[key]):
                raise PopError(
                    f"{key} of the Gaussians that are held fixed are others than this training was begun with; remove "
                    "its result folder and start it again"
                )
        self._stepper.rebind(params, optimizers, state)

    def steps(self, first: int, last: int, phase: Phase) -> list[StepStats]:
        """See `Stepper.steps`."""
        found: list[StepStats] = []
        for step in range(first, last):
            try:
                found += self._stepper.steps(step, step + 1, phase)
            finally:
                self.step = self._stepper.step
            if self.step == step:
                break
            for key, place in self._places.items():
                place.copy_(self._rows[key])
        return found

    def facts(self) -> dict[str, Any]:
        """See `Stepper.facts`; `fixed_gaussians` says how many are held."""
        return {**self._stepper.facts(), "fixed_gaussians": len(self._rows["means"])}
