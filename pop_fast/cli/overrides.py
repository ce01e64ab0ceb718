"""Which settings of a training run the words of a command line name; all others are defaults."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, Final

from pop_fast.train.config import TrainConfig
from pop_fast.train.presets import ALIASES, METHODS, PRESETS

# what decides the defaults of all other settings
PLAN: Final = ("method", "preset", "steps_scaler", "scale_lambda_pop")


def plan_of(words: Sequence[str]) -> dict[str, Any]:
    """Find what decides the defaults; a value that cannot be is left out, for the parser of all words to refuse."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("method", "preset", "steps-scaler"):
        parser.add_argument(f"--{name}", nargs="?")
    parser.add_argument("--scale-lambda-pop", action="store_true")
    found = parser.parse_known_args([_dashed(word) for word in words if word != "--"])[0]
    plan: dict[str, Any] = {"scale_lambda_pop": found.scale_lambda_pop}
    plan |= {"method": found.method} if found.method in (*METHODS, *ALIASES) else {}
    plan |= {"preset": found.preset} if found.preset in PRESETS else {}
    with contextlib.suppress(TypeError, ValueError):
        plan["steps_scaler"] = float(found.steps_scaler)
    return plan


def overrides(args: Any, base: TrainConfig, words: Sequence[str]) -> dict[str, Any]:
    """Return the settings that the words name, also where what they say is the default.

    Args:
        args: what the words were parsed into, with the attributes of `base`.
        base: the defaults.
        words: the words.

    Returns:
        Values by dotted name, as `TrainConfig.of` takes them.
    """
    named = {_dashed(word).partition("=")[0].removeprefix("--") for word in words if word.startswith("--")}
    found: dict[str, Any] = {}
    for name, value, default in _settings(args, base):
        group, dot, last = {"result_dir": "out"}.get(name, name).replace("_", "-").rpartition(".")
        if value != default or named & {f"{group}{dot}{last}", f"{group}{dot}no-{last}"}:
            found[name] = value
    return found


def _settings(args: Any, base: TrainConfig) -> Iterator[tuple[str, Any, Any]]:
    """Give every setting's dotted name, its value and its default."""
    for field in dataclasses.fields(TrainConfig):
        if field.name == "given":
            continue
        value, default = getattr(args, field.name), getattr(base, field.name)
        group = base.method if field.name == "strategy" else field.name
        if not dataclasses.is_dataclass(value):
            yield group, value, default
            continue
        for inner in dataclasses.fields(value):
            yield f"{group}.{inner.name}", getattr(value, inner.name), getattr(default, inner.name)


def _dashed(word: str) -> str:
    """Spell an option's name with dashes, as tyro takes both spellings."""
    name, equals, value = word.partition("=")
    return (name.replace("_", "-") if name.startswith("--") else name) + equals + value
