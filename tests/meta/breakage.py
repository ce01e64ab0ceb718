"""Break a public function of the oracle wherever it is used, a little and in every value that it returns."""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

import pop_ref
from pop_ref.conformance.reference import forget
from pop_ref.magnitudes import Rounded

NUDGE = 1.0 + 2.0**-10


def public_functions() -> dict[str, Callable[..., Any]]:
    """Return the oracle's public functions as `module.function`."""
    found = {}
    for info in pkgutil.iter_modules(pop_ref.__path__):
        if info.ispkg or info.name.startswith("_"):
            continue
        module = importlib.import_module(f"pop_ref.{info.name}")
        for name, value in vars(module).items():
            if inspect.isfunction(value) and value.__module__ == module.__name__ and not name.startswith("_"):
                found[f"{info.name}.{name}"] = value
    return found


def nudged(value: Any) -> Any:
    """Return a value that is a little wrong: numbers scaled, integers off by one, truths negated, lists cut."""
    if isinstance(value, np.ndarray):
        return _nudged_array(value)
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, int | np.integer):
        return value + 1
    if isinstance(value, float | np.floating):
        return value * NUDGE
    if isinstance(value, Rounded):
        return Rounded(value.value * NUDGE, value.error * NUDGE)
    if isinstance(value, str):
        return f"not {value}"
    if isinstance(value, dict):
        return {key: nudged(each) for key, each in value.items()}
    if isinstance(value, tuple):
        each = [nudged(v) for v in value]
        return type(value)(*each) if hasattr(value, "_fields") else tuple(each)
    if isinstance(value, list):
        return [nudged(v) for v in value[:-1]]
    if is_dataclass(value) and not isinstance(value, type):
        wrong = {f.name: nudged(getattr(value, f.name)) for f in fields(value) if _can_be_wrong(getattr(value, f.name))}
        return replace(value, **wrong)
    return value


def _can_be_wrong(value: Any) -> bool:
    return isinstance(value, np.ndarray | float | int | dict | tuple | str)


def _nudged_array(array: np.ndarray) -> np.ndarray:
    if array.dtype == bool:
        return ~array
    if array.dtype.kind == "i":
        return array + 1
    # zeros do not scale
    return array * NUDGE if np.any(array) else array + 2.0**-10


def _broken(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def wrong(*args: Any, **kwargs: Any) -> Any:
        value = function(*args, **kwargs)
        if value is not None:
            return nudged(value)
        # it works by changing an argument: a tuple of totals
        for argument in (*args, *kwargs.values()):
            for array in argument if isinstance(argument, tuple) else ():
                if isinstance(array, np.ndarray):
                    array *= NUDGE
        return None

    return wrong


@contextmanager
def broken(function: Callable[..., Any]) -> Iterator[None]:
    """Break a function in every module that holds it, for the duration of a with statement."""
    wrong = _broken(function)
    places = [
        (module, name)
        for module in list(sys.modules.values())
        for name, value in list(getattr(module, "__dict__", {}).items())
        if value is function
    ]
    for module, name in places:
        setattr(module, name, wrong)
    forget()
    try:
        yield
    finally:
        for module, name in places:
            setattr(module, name, function)
        forget()
