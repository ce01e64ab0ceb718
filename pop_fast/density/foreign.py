"""Strategies of other people: what follows gsplat's protocol, asked as a training run asks its own strategies."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from pop_fast.density.protocol import DensificationStep, Draws, Info, Optimizers, Params, State, Strategy
from pop_ref.settings import MAX_SH_DEGREE


class ForeignStrategy:
    """A strategy that collects and changes in one call, `step_post_backward`, as gsplat's do.

    Where it draws random numbers with torch's global generator, they come from one in `state` that is saved with it, so
    that a run that is resumed continues to the same bits. When it changes the Gaussians is not known beforehand; a
    `DensificationStep` that it returns goes into the records.

    Args:
        strategy: follows `pop_fast.density.protocol.Strategy`. A method `regularizer` or `needs_dominance`, where it
            has one, is called as those of `DensityControl` are.
    """

    def __init__(self, strategy: Strategy) -> None:
        self.strategy = strategy
        self.absgrad = bool(getattr(strategy, "absgrad", False))
        self._info: Info | None = None
        self._lends = True

    @property
    def name(self) -> str:
        """Return the name of its class."""
        return type(self.strategy).__name__

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """See `Strategy.check_sanity`."""
        self.strategy.check_sanity(params, optimizers)

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0, count: int = 0) -> State:
        """Return the strategy's own state and, unless it has one, a generator for its random numbers."""
        own = self.strategy.initialize_state(scene_scale=scene_scale)
        self._lends = "generator" not in own
        return {**own, "generator": torch.Generator().manual_seed(seed)} if self._lends else own

    def needs_dominance(self, step: int) -> bool:
        """Tell whether `info["dominant_counts"]` is read at this step."""
        asked: Callable[[int], bool] | None = getattr(self.strategy, "needs_dominance", None)
        return asked is not None and asked(step)

    def changes_after(self, step: int) -> bool:
        """Tell whether the Gaussians may change after this step: always."""
        return True

    def needs_passes(self, step: int) -> bool:
        """Tell whether the change after this step looks at the training views: gsplat's protocol has none."""
        return False

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return the term that it adds to the loss, or None."""
        term: Callable[..., Tensor | None] | None = getattr(self.strategy, "regularizer", None)
        return None if term is None else term(opacities, state, step, info)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info) -> None:
        """See `Strategy.step_pre_backward`."""
        self.strategy.step_pre_backward(params, optimizers, state, step, info)

    def collect(self, params: Params, state: State, step: int, info: Info, packed: bool = False) -> None:
        """Keep what the step's render returned for `change`, in which the strategy itself collects."""
        self._info = info

    def change(
        self,
        params: Params,
        optimizers: Optimizers,
        state: State,
        step: int,
        draws: Draws | None = None,
        passes: Any = None,
        sh_degree: int = MAX_SH_DEGREE,
    ) -> DensificationStep | None:
        """Call `step_post_backward`."""
        info, self._info = self._info, None
        if info is None:
            raise ValueError("change needs the info of the step before it; call collect first")
        with _drawing_from(state["generator"]) if self._lends else nullcontext():
            found: Any = self.strategy.step_post_backward(params, optimizers, state, step, info)
        return found if isinstance(found, DensificationStep) else None


@contextmanager
def _drawing_from(generator: torch.Generator) -> Iterator[None]:
    """Let torch's global generator on the CPU be this one for a while."""
    with torch.random.fork_rng(devices=[]):
        torch.set_rng_state(generator.get_state())
        yield
        generator.set_state(torch.get_rng_state())
