"""Dataclasses to plain JSON values and back, with errors that name the field."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from pop_fast.errors import PopError

T = TypeVar("T")
# up to here a float holds every whole number
_LARGEST = 2**53
# compiling the annotations takes as long as all else
_hints: Callable[[type], dict[str, Any]] = cache(get_type_hints)


def to_plain(value: Any) -> Any:
    """Turn nested dataclasses, dicts and tuples into dicts and lists."""
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {name: to_plain(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [to_plain(item) for item in value]
    return value


def from_plain(kind: type[T], plain: Any, where: str, skipped: tuple[str, ...] = ()) -> T:
    """Build a dataclass from what `to_plain` made of it; absent fields keep their default.

    Args:
        kind: the dataclass.
        plain: the values by name.
        where: what errors call it.
        skipped: fields that plain values cannot give.

    Raises:
        PopError: an unknown field, or a value of the wrong type; names it as `where.field`.
    """
    if not isinstance(plain, dict):
        raise PopError(f"{where} is {_shown(plain)}; it must be an object of settings")
    hints = {name: hint for name, hint in _hints(kind).items() if name not in skipped}
    for name in plain:
        if name not in hints:
            raise PopError(f"{where}.{name} is not a setting; the settings are {', '.join(hints)}")
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in plain.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    origin, args = get_origin(hint), get_args(hint)
    if is_dataclass(hint) and isinstance(hint, type):
        return from_plain(hint, value, where)
    if origin is Literal:
        if value not in args:
            raise PopError(f"{where} is {_shown(value)}; it must be one of {', '.join(map(_shown, args))}")
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        return _value(next(arg for arg in args if arg is not type(None)), value, where)
    if origin is tuple:
        if not isinstance(value, list):
            raise PopError(f"{where} is {_shown(value)}; it must be a list")
        any_length = len(args) == 2 and args[1] is Ellipsis
        if not any_length and len(value) != len(args):
            raise PopError(f"{where} has {len(value)} values; it must have {len(args)}")
        kinds = [args[0]] * len(value) if any_length else args
        return tuple(_value(k, item, f"{where}[{i}]") for i, (k, item) in enumerate(zip(kinds, value, strict=True)))
    return _scalar(hint, value, where)


def _scalar(hint: Any, value: Any, where: str) -> Any:
    if isinstance(value, int) and abs(value) > _LARGEST:
        raise PopError(f"{where} is a number beyond 2^53; no setting is as large")
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        names = {int: "a whole number", float: "a number", str: "a text", bool: "true or false"}
        raise PopError(f"{where} is {_shown(value)}; it must be {names[hint]}")
    return value


def _shown(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value)
