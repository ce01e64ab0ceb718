"""What the step on a GPU reads of a run, as whoever trains with it has it; `pop_fast.train.steps` explains each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pop_ref.constants import Profile
from pop_ref.settings import Objective


class Updates(Protocol):
    """Learning rates and numbers of Adam's updates, [steps, parameters] each, and the decay of its moments."""

    @property
    def rates(self) -> Tensor: ...
    @property
    def numbers(self) -> Tensor: ...
    @property
    def sh_rest_every(self) -> int: ...
    @property
    def betas(self) -> tuple[float, float]: ...


class StepSettings(Protocol):
    """What stays the same over a run."""

    @property
    def updates(self) -> Updates: ...
    @property
    def lambda_pop(self) -> float: ...
    @property
    def lambda_entropy(self) -> float: ...
    @property
    def opacity_reg(self) -> float: ...
    @property
    def scale_reg(self) -> float: ...
    @property
    def pop_views(self) -> str: ...
    @property
    def pop_over(self) -> str: ...
    @property
    def blur_window(self) -> str: ...
    @property
    def background(self) -> tuple[float, float, float]: ...
    @property
    def profile(self) -> Profile: ...
    @property
    def antialiased(self) -> bool: ...
    @property
    def backward(self) -> str: ...
    @property
    def deterministic(self) -> bool: ...
    @property
    def eps(self) -> float: ...
    @property
    def replay(self) -> bool: ...
    @property
    def counts(self) -> bool: ...
    def blur_pixels(self, kept_pixels: int) -> float: ...


class Phase(Protocol):
    """What one kind of step does; hashable."""

    @property
    def sh_degree(self) -> int: ...
    @property
    def pop(self) -> bool: ...
    @property
    def entropy(self) -> bool: ...
    @property
    def statistics(self) -> bool: ...
    @property
    def blur(self) -> bool: ...
    @property
    def window(self) -> bool: ...
    @property
    def dominance(self) -> bool: ...
    @property
    def objective(self) -> Objective: ...


class Ranks(Protocol):
    """Processes that train together; `pop_fast.train.ranks` explains each."""

    @property
    def rank(self) -> int: ...
    @property
    def size(self) -> int: ...
    def positions(self, batch: int) -> range: ...
    def gather(self, mine: Sequence[Tensor]) -> list[Tensor]: ...
    def exchange(self, sent: Sequence[Tensor], received: Sequence[int]) -> list[Tensor]: ...
    def share(self, whole: Tensor, bounds: Sequence[int]) -> None: ...


@dataclass
class KernelStatistics:
    """What the kernels collect, one entry a Gaussian, until new rows come.

    `sh_rest_sum` is Adam's, of the same life: gradients that wait for their update; None where none do. [N, n_rest, 3]
    """

    grad_sum: Tensor
    n_visible: Tensor
    dominant_sum: Tensor
    blurred: Tensor
    sh_rest_sum: Tensor | None = None

    @classmethod
    def zeros(cls, n: int, device: torch.device, n_rest: int | None = None) -> KernelStatistics:
        """Start from nothing; `n_rest` bands' gradients wait, None for none."""
        visible, dominant = (torch.zeros(n, dtype=torch.int32, device=device) for _ in range(2))
        flags = torch.zeros(n, dtype=torch.uint8, device=device)
        waiting = None if n_rest is None else torch.zeros((n, n_rest, 3), device=device)
        return cls(torch.zeros(n, device=device), visible, dominant, flags, waiting)

    def rows(self, own: slice) -> KernelStatistics:
        """Return some rows, in the same memory."""
        waiting = None if self.sh_rest_sum is None else self.sh_rest_sum[own]
        return KernelStatistics(
            self.grad_sum[own], self.n_visible[own], self.dominant_sum[own], self.blurred[own], waiting
        )
