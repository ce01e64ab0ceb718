"""The protocol that every density strategy follows; it is gsplat's, so that a strategy serves both trainers.

A trainer holds a dict of raw parameters (`means`, `scales` in log, `quats`, `opacities` in logit, `sh0`, `shN`) and one
optimizer per key. Every step it calls, in this order,

    strategy.step_pre_backward(params, optimizers, state, step, info)
    loss.backward()
    optimizers step                       (gsplat >= 1.5: the optimizers move first, then the strategy looks)
    strategy.step_post_backward(params, optimizers, state, step, info)

`info` is the dict that `rasterization()` returns last. `step` counts from 0. A strategy is a dataclass of settings;
everything that changes lives in `state`. What a step did to the Gaussians is returned, as a `DensificationStep`;
gsplat's own strategies return nothing. `ForeignStrategy` lets a training run ask a strategy of other people as its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, runtime_checkable

from pop_ref.settings import MAX_SH_DEGREE, SPLIT_CHILDREN

if TYPE_CHECKING:
    import torch
    from torch import Tensor
    from torch.optim import Optimizer

    from pop_fast.density.passes import Passes

Params: TypeAlias = MutableMapping[str, Any]
Optimizers: TypeAlias = "Mapping[str, Optimizer]"
State: TypeAlias = dict[str, Any]
Info: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class Draws:
    """Where a change of the Gaussians takes its random numbers from."""

    # given n, standard normal draws for the children of n split parents, on the CPU. -> [2, n, 3]
    normals: Callable[[int], Tensor]
    uniforms: Callable[[int], Tensor]  # given n, draws from [0, 1), on the CPU. -> [n] float64

    @classmethod
    def of(cls, generator: torch.Generator) -> Draws:
        """Draw from a generator on the CPU; the normals in float32, whatever trains and in what precision."""
        import torch

        return cls(
            normals=lambda n: torch.randn((SPLIT_CHILDREN, n, 3), generator=generator, dtype=torch.float32),
            uniforms=lambda n: torch.rand(n, generator=generator, dtype=torch.float64),
        )


@dataclass(frozen=True)
class DensificationContext:
    """The Gaussians at a step after which they may change, and what a change may ask for."""

    params: Params  # raw parameters, replaced under their keys
    optimizers: Optimizers  # one per key; `rows` says what they hold where several GPUs train
    state: State  # the strategy's
    step: int  # just taken, from 0
    draws: Draws  # random numbers
    passes: Passes | None = None  # over the training views; None in a trainer that has none
    sh_degree: int = MAX_SH_DEGREE  # colour bands that are drawn

    def __len__(self) -> int:
        return len(self.params["means"])

    @property
    def views(self) -> Passes:
        """Return the passes over the training views; ValueError where the trainer has none."""
        if self.passes is None:
            raise ValueError("this strategy looks at the training views when it changes the Gaussians; give it passes")
        return self.passes


@dataclass(frozen=True)
class DensificationStep:
    """What density control did to the Gaussians after a step."""

    cloned: int = 0  # Gaussians that were copied
    split: int = 0  # Gaussians that two smaller ones replaced
    pruned: int = 0  # Gaussians that were removed
    reset: bool = False  # whether all opacities were lowered
    replaced: int = 0  # Gaussians that took the place of all there were

    def record(self) -> dict[str, Any]:
        """Return what a record of metrics.jsonl says about it; what is rare is mentioned only where it happened."""
        counts = {"cloned": self.cloned, "split": self.split, "pruned": self.pruned}
        rare = {"reset": self.reset, "replaced": self.replaced}
        return {**counts, **{name: value for name, value in rare.items() if value}}


@runtime_checkable
class Strategy(Protocol):
    """What a trainer asks of a strategy."""

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Raise ValueError when the parameters and the optimizers are not laid out as the protocol says."""
        ...

    def initialize_state(self, scene_scale: float = 1.0) -> State:
        """Return what the strategy remembers between steps."""
        ...

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info) -> None:
        """Prepare for the backward pass: ask autograd to keep the gradient of the screen centres."""
        ...

    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info, packed: bool = False
    ) -> Any:
        """Collect statistics and, when it is time, change the Gaussians; may return a `DensificationStep`."""
        ...


def check_layout(params: Params, optimizers: Optimizers, needed: tuple[str, ...]) -> None:
    """Raise ValueError when keys, optimizers or row counts do not fit the protocol."""
    missing = [key for key in needed if key not in params]
    if missing:
        raise ValueError(f"params has no {missing[0]!r}; a strategy needs {', '.join(needed)}")
    trainable = {key for key, value in params.items() if value.requires_grad}
    if trainable != set(optimizers):
        odd = sorted(trainable.symmetric_difference(optimizers))[0]
        have = "a parameter without an optimizer" if odd in trainable else "an optimizer without a trainable parameter"
        raise ValueError(f"{odd!r} is {have}; give every trainable parameter its own optimizer under the same key")
    rows = len(params[needed[0]])
    for key, value in params.items():
        if len(value) != rows:
            raise ValueError(f"{key!r} has {len(value)} rows but {needed[0]!r} has {rows}; rows are Gaussians")
    for key, optimizer in optimizers.items():
        groups = optimizer.param_groups
        if len(groups) != 1 or len(groups[0]["params"]) != 1 or groups[0]["params"][0] is not params[key]:
            raise ValueError(f"optimizers[{key!r}] must hold exactly one tensor, params[{key!r}]")


def visible_from_radii(radii: Tensor) -> Tensor:
    """Return which Gaussians each camera sees: all extents > 0. [C, N, 2] (or [C, N] before gsplat 1.5) -> [C, N]"""
    return (radii > 0).all(-1) if radii.dim() == 3 else radii > 0


def visible_in(info: Info, n: int) -> Tensor:
    """Return which of n Gaussians any camera sees, packed or not. [N]"""
    import torch

    if info.get("gaussian_ids") is None:
        return visible_from_radii(info["radii"]).any(0)
    visible = torch.zeros(n, dtype=torch.bool, device=info["radii"].device)
    visible[info["gaussian_ids"].long()] = True
    return visible


def dominant_counts(info: Info) -> Tensor:
    """Return how many pixels each Gaussian dominates in each view, [C, N], or say why it cannot be known."""
    counts = info.get("dominant_counts")
    if counts is None:
        raise ValueError(
            "info has no 'dominant_counts', which POP needs: render with pop_fast.rasterization "
            "(a drop-in for gsplat's), or add to info, [cameras, Gaussians], the number of pixels in which each "
            "Gaussian has the largest blending weight"
        )
    return counts


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
        return type(self.strategy).__name__

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        self.strategy.check_sanity(params, optimizers)

    def initialize_state(self, scene_scale: float = 1.0, seed: int = 0, count: int = 0) -> State:
        """Return the strategy's own state and, unless it has one, a generator for its random numbers."""
        import torch

        own = self.strategy.initialize_state(scene_scale=scene_scale)
        self._lends = "generator" not in own
        return {**own, "generator": torch.Generator().manual_seed(seed)} if self._lends else own

    def needs_dominance(self, step: int) -> bool:
        asked: Callable[[int], bool] | None = getattr(self.strategy, "needs_dominance", None)
        return asked is not None and asked(step)

    def changes_after(self, step: int) -> bool:
        return True

    def needs_passes(self, step: int) -> bool:
        """Tell whether the change after this step looks at the training views: gsplat's protocol has none."""
        return False

    def reads_colors(self, step: int) -> bool:
        return True

    def regularizer(self, opacities: Tensor, state: State, step: int, info: Info) -> Tensor | None:
        """Return the term that it adds to the loss, or None."""
        term: Callable[..., Tensor | None] | None = getattr(self.strategy, "regularizer", None)
        return None if term is None else term(opacities, state, step, info)

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Info) -> None:
        self.strategy.step_pre_backward(params, optimizers, state, step, info)

    def collect(self, params: Params, state: State, step: int, info: Info) -> None:
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
    import torch

    with torch.random.fork_rng(devices=[]):
        torch.set_rng_state(generator.get_state())
        yield
        generator.set_state(torch.get_rng_state())
