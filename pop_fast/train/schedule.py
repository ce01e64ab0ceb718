"""What depends on the step number alone: the learning rate of the means, the active colour bands, the view order."""

from __future__ import annotations

from typing import Any

import torch


def means_lr(step: int, max_steps: int, initial: float, decay: float) -> float:
    """Return the means' learning rate, log-linear from start to end: `initial * decay^(step / max_steps)`."""
    return initial * decay ** min(step / max_steps, 1.0)


def active_sh_degree(step: int, interval: int, degree: int) -> int:
    """Return the highest active colour band: one more every `interval` steps, from 0."""
    return min(step // interval, degree)


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

    def state_dict(self) -> dict[str, Any]:
        """Return all that decides the views to come."""
        return {"generator": self._generator.get_state(), "order": list(self._order), "position": self._position}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue where `state_dict` was taken."""
        self._generator.set_state(state["generator"])
        self._order = list(state["order"])
        self._position = int(state["position"])
