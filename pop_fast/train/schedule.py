"""What depends on the step number alone: rates and numbers of Adam's updates, active colour bands, the view order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cuda_ext.train_settings import GROUPS, Updates, steady_updates
from pop_ref.settings import LearningRates, UpdateRules

__all__ = ["Updates", "ViewOrder", "active_sh_degree", "steady_updates", "updates_of"]


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
        lr: the rates to begin with.
        scene_scale: the unit of the means' rate, world units.
        max_steps: length of the run, over which the means' rate decays.
        rules: whom Adam moves when; None moves all at every step.
        edits: steps after which Gaussians are added or removed; those outside the run are left out.
        restarts: steps after which Adam begins anew, likewise.
    """
    rules = rules or UpdateRules()
    edits, restarts = ([step for step in given if 0 <= step < max_steps] for given in (edits, restarts))
    steps = torch.arange(max_steps, dtype=torch.float64)
    base = {**lr.by_parameter(), "means": lr.means * scene_scale}
    rates = torch.tensor([base[name] for name in GROUPS], dtype=torch.float64).repeat(max_steps, 1)
    rates *= _round_factor(steps, rules)[:, None]
    rates[:, GROUPS.index("means")] = base["means"] * lr.means_decay ** _share(steps, max_steps, rules)
    moved = torch.ones((max_steps, len(GROUPS)), dtype=torch.bool)
    if rules.edits_replace_update:
        moved[[*edits, *restarts]] = False
    if rules.opacities_stop_iter >= 0:
        moved[rules.opacities_stop_iter :, GROUPS.index("opacities")] = False
    moved[:, GROUPS.index("shN")] &= (steps + 1) % rules.sh_rest_every == 0
    numbers = moved.cumsum(0)
    for step in sorted(restarts):
        numbers[step + 1 :] -= numbers[step].clone()
    return Updates(rates, (numbers * moved).to(torch.int32), rules.sh_rest_every)


def _share(steps: Tensor, max_steps: int, rules: UpdateRules) -> Tensor:
    """Return how much of the means' decay lies behind each step."""
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
