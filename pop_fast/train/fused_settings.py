"""Which settings the fused steps know: the whole step on a GPU, and that in C++."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pop_fast.train.config import TrainConfig


def unsupported_setting(config: TrainConfig) -> str | None:
    """Return the dotted name of a setting that the step in C++ does not know, or None."""
    found = _first(_unknown(config))
    return None if found is None else found[0]


def unsupported(config: TrainConfig) -> str | None:
    """Return one sentence on a setting that the step on a GPU does not know and what to do, or None."""
    prior = {f"{config.method}.lambda_entropy": (config.strategy.lambda_entropy, 0.0)}
    found = _first({**_unknown(config), **prior})
    if found is None:
        return None
    name, value, supported = found
    if name in ("exposure", "random_background", "refine_cameras"):
        option = name.replace("_", "-")
        return f"backend 'cuda' trains without {name}; use --backend fast, or leave out --{option}"
    return (
        f"backend 'cuda' trains with {name} = {supported!r} only, not {value!r}; "
        f"use --backend fast, or leave {name} as it is"
    )


def _first(known: Mapping[str, tuple[Any, Any]]) -> tuple[str, Any, Any] | None:
    """Return name, value and the one supported value of the first setting that is not known."""
    return next(((name, *pair) for name, pair in known.items() if pair[0] != pair[1]), None)


def _unknown(config: TrainConfig) -> dict[str, tuple[Any, Any]]:
    """Return value and the one supported value of the settings that neither step knows, by dotted name."""
    plan, method = config.strategy, config.method
    return {
        "batch_size": (config.batch_size, 1),
        f"{method}.absgrad": (plan.absgrad, False),
        f"{method}.key_for_gradient": (plan.key_for_gradient, "means2d"),
        f"{method}.refine_scale2d_stop_iter": (plan.refine_scale2d_stop_iter, 0),
        "exposure": (config.exposure, False),
        "random_background": (config.random_background, False),
        "refine_cameras": (config.refine_cameras, False),
    }
