"""Which values the settings of a run may have; a refusal is one line that names the setting as `pop train` does."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Final

from pop_fast.api.registry import BACKENDS
from pop_fast.errors import PopError
from pop_fast.train.presets import LOSSES
from pop_ref.constants import PROFILES

_AT_LEAST: Final = {
    "max_steps": 1,
    "batch_size": 1,
    "seed": 0,
    "factor": 1,
    "sh_degree": 0,
    "sh_interval": 1,
    "test_every": 0,
    "threads": 0,
    "checkpoint_every": 0,
    "keep_checkpoints": 1,
    "log_every": 1,
    "max_renders": 0,
    "target_cache_mb": 0,
    "l2_stop_iter": 0,
}
# photographs shrunk by 16 show little
_MOST_COARSE_STOPS: Final = 4
# each takes memory of its own, and beyond what the system allows the libraries end the process
_MOST_THREADS: Final = 512
# numbers that are divided by, or of which a logarithm is taken
_OVER_ZERO: Final = (
    "init_scale",
    "photometric_divisor",
    "lr.means_decay",
    "lr.others_decay",
    "appearance_lr.exposures_decay",
    "appearance_lr.cameras_decay",
)
# of the strategy, whose settings errors call by the method's name as the command line does
_AT_LEAST_OF_STRATEGY: Final = {
    **dict.fromkeys(("refine_every", "sh_rest_every", "round_steps", "round_decay_every"), 1),
    **dict.fromkeys(("score_views", "score_divisor", "reinit_points", "max_gaussians"), 1),
    **dict.fromkeys(("reset_every", "pause_refine_after_reset", "final_count", "sampled_prunes"), 0),
}
_SHARES_OF_STRATEGY: Final = (
    *("prune_opa", "theta_blur", "reset_opa", "final_prune_opa", "soft_prune_share", "hard_prune_share"),
    *("prune_shares", "sampling_factor", "prune_mass"),
)
# of which a logarithm is taken from both sides
_BETWEEN_OF_STRATEGY: Final = ("reinit_opacity",)


def check_values(config: Any) -> None:
    """Check every setting of a run.

    Args:
        config: a `TrainConfig`, or a dataclass with the same settings.

    Raises:
        PopError: a setting is out of range or, being a number, not finite.
    """
    values, method = dict(_flat(config)), config.method
    _check_names(values)
    own = {name: value for name, value in values.items() if name.startswith(f"{method}.")}
    shares = ("lambda_ssim", *(name for name in own if name.removeprefix(f"{method}.") in _SHARES_OF_STRATEGY))
    known = {f"{method}.{name}": least for name, least in _AT_LEAST_OF_STRATEGY.items()}
    at_least = {**_AT_LEAST, **{name: least for name, least in known.items() if name in own}}
    for name, smallest in at_least.items():
        if values[name] is not None and values[name] < smallest:
            raise PopError(f"{name} is {values[name]}; it must be at least {smallest}")
    if values["threads"] > _MOST_THREADS:
        raise PopError(f"threads is {values['threads']}; it must be at most {_MOST_THREADS}; 0 takes all cores")
    if values["sh_degree"] > 3:
        raise PopError(f"sh_degree is {values['sh_degree']}; it must be 0, 1, 2 or 3")
    for name in ("init_opacity", "lr.beta2", *(f"{method}.{name}" for name in _BETWEEN_OF_STRATEGY)):
        if name in values and not 0.0 < values[name] < 1.0:
            raise PopError(f"{name} is {values[name]}; it must lie between 0 and 1")
    stops = values["coarse_stop_iters"]
    if any(stop < 0 for stop in stops) or list(stops) != sorted(stops) or len(stops) > _MOST_COARSE_STOPS:
        raise PopError(
            f"coarse_stop_iters is {list(stops)}; it must be at most {_MOST_COARSE_STOPS} step numbers that ascend"
        )
    if any(not 0.0 <= value <= 1.0 for value in values["background"]):
        raise PopError(f"background is {list(values['background'])}; every channel must lie in [0, 1]")
    for name in (*_OVER_ZERO, *shares, *(name for name, value in values.items() if isinstance(value, float))):
        for value in values[name] if isinstance(values[name], tuple) else (values[name],):
            _check_number(name, value, name in shares)


def _check_names(values: dict[str, Any]) -> None:
    """Check what is one of a table, to which other packages may add."""
    for name, known in (("profile", PROFILES), ("photometric", LOSSES), ("backend", BACKENDS)):
        value = values[name]
        if (name == "backend" and value == "auto") or value in known:
            continue
        names = ", ".join((*(("auto",) if name == "backend" else ()), *known))
        where = "; one of another package is known where that is installed"
        raise PopError(f"{name} is {value!r}; it must be one of {names}{where}")


def _check_number(name: str, value: float, is_share: bool) -> None:
    if is_share:
        right, meaning = 0.0 <= value <= 1.0, "lie in [0, 1]"
    elif name in _OVER_ZERO:
        right, meaning = 0.0 < value < math.inf, "be > 0 and finite"
    else:
        right, meaning = 0.0 <= value < math.inf, "be >= 0 and finite"
    if not right:
        raise PopError(f"{name} is {value}; it must {meaning}")


def _flat(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    for field in fields(config):
        value = getattr(config, field.name)
        if field.name == "given":
            continue
        if is_dataclass(value):
            yield from _flat(value, f"{config.method if field.name == 'strategy' else field.name}.")
        else:
            yield f"{prefix}{field.name}", value
