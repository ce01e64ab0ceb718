"""Steps that a backend takes as a whole, in C++ or on a GPU, and which settings they know."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from pop_fast.api.backend import Backend
    from pop_fast.train.config import TrainConfig

# settings that neither step of this package knows, with the one value that it trains with; "strategy." are the method's
_ONLY: Final[Mapping[str, Any]] = MappingProxyType(
    {
        "batch_size": 1,
        "strategy.absgrad": False,
        "strategy.key_for_gradient": "means2d",
        "strategy.refine_scale2d_stop_iter": 0,
        "exposure": False,
        "random_background": False,
        "refine_cameras": False,
    }
)


@dataclass(frozen=True)
class WholeStep:
    """What a backend offers beside its stages where it takes training steps by itself.

    Attributes:
        name: of what takes the steps, for the statistics of a run.
        make: given a `pop_fast.train.stepper.Task`, returns what makes a `pop_fast.train.fused_stepper.Fused`.
        most: steps at a time, however quick they are, before the program looks up: Ctrl-C, the progress bar.
        losses: names of the losses between pixels that it knows.
        only: settings by name, with the one value of each that it knows; those of the strategy begin with "strategy.".
        depends_on_threads: whether another number of threads may round otherwise.
    """

    name: str
    make: Callable[[Any], Callable[..., Any]]
    most: int
    losses: tuple[str, ...] = ("l2", "l1")
    only: Mapping[str, Any] = field(default_factory=lambda: _ONLY)
    depends_on_threads: bool = True

    def unknown(self, config: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
        """Give name, value and the one known value of every setting that it does not know."""
        for name, known in self.only.items():
            group, _, inner = name.rpartition(".")
            value = getattr(config.strategy if group else config, inner)
            if value != known:
                yield f"{config.method}.{inner}" if group else name, value, known
        for loss in dict.fromkeys((config.photometric, config.objective_at(config.max_steps).pixelwise)):
            if loss not in self.losses:
                yield "photometric", loss, self.losses[0]

    def unknown_setting(self, config: TrainConfig) -> str | None:
        """Return the dotted name of a setting that it does not know, or None."""
        return next((name for name, _, _ in self.unknown(config)), None)


def why_not_trained(backend: Backend, config: TrainConfig, own_strategy: bool = True) -> str | None:
    """Return one sentence on why a backend cannot take the steps of a run and what to do, or None.

    Where the tensors are the CPU's, autograd over the stages takes whatever steps a whole one does not know.

    Args:
        backend: which can run here.
        config: the settings.
        own_strategy: whether the density strategy is one of this package.
    """
    if backend.device == "cpu":
        return None
    step, name = backend.whole_step(), backend.name
    if step is None:
        return f"backend {name!r} takes no training steps on {backend.device!r}; use --backend fast"
    if not own_strategy:
        return f"backend {name!r} trains with the strategies of this package only; use --backend fast"
    found = next(step.unknown(config), None)
    if found is None:
        return None
    setting, value, known = found
    if known is False and "." not in setting:
        option = setting.replace("_", "-")
        return f"backend {name!r} trains without {setting}; use --backend fast, or leave out --{option}"
    return (
        f"backend {name!r} trains with {setting} = {known!r} only, not {value!r}; "
        f"use --backend fast, or leave {setting} as it is"
    )
