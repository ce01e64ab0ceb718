"""How arguments and results of functions cross to a program: words and arrays by name.

A value is written as words `name=value`: whole numbers, numbers, 0 and 1 for false and true, texts, `none`. An array is
`name=[3,4]`, its shape, and its values follow the line as float64, in the order of the words. Fields of a record and
entries of a mapping have names of their own, `config.prune_opa=0.005`, `rows.params.means=[8,3]`, as have the items of
a tuple, `value.0=[8]`; tuples and lists of numbers are arrays. Lists of whole numbers for each tile are two arrays:
`lists.items=[40]`, one list after the other, and `lists.ends=[6]`, where each ends. A function is the word `draw`.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from pop_ref.conformance.adapter import stage_function

DRAW = "draw"
NONE = "none"


def encoded(value: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Yield a value's words by name: texts for the line, arrays, and functions as they are."""
    if _record(type(value)):
        for field in _record(type(value)):
            yield from encoded(getattr(value, field), f"{name}.{field}")
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from encoded(item, f"{name}.{key}")
    elif isinstance(value, list) and value and isinstance(value[0], list):
        yield f"{name}.items", np.array([item for each in value for item in each], dtype=np.float64)
        yield f"{name}.ends", np.cumsum([len(each) for each in value]).astype(np.float64)
    elif isinstance(value, tuple | list) and not all(isinstance(each, int | float | np.number) for each in value):
        for k, item in enumerate(value):
            yield from encoded(item, f"{name}.{k}")
    elif isinstance(value, np.ndarray | tuple | list):
        yield name, np.asarray(value, dtype=np.float64)
    elif isinstance(value, bool | np.bool_):
        yield name, str(int(value))
    elif isinstance(value, float | np.floating):
        yield name, repr(float(value))
    else:
        yield name, NONE if value is None else value if callable(value) else str(value)


def line_of(words: list[tuple[str, Any]]) -> str:
    """Return the words as they stand on a line."""
    return " ".join(f"{name}={_word(value)}" for name, value in words)


def _word(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"[{','.join(map(str, value.shape))}]"
    return DRAW if callable(value) else value


def decoded(kind: Any, given: Mapping[str, Any], name: str) -> Any:
    """Return the value of a type that arrays by name, and texts by name as they stand on a line, hold.

    Raises:
        KeyError: a part is lacking; its name.
        ValueError: what should be one number, or whole, is not.
    """
    kind, optional = _without_none(kind)
    if optional and (str(given.get(name)) == NONE or not any(_is_part(key, name) for key in given)):
        return None
    if _record(kind):
        hints = get_type_hints(kind)
        return kind(**{field: decoded(hints[field], given, f"{name}.{field}") for field in _record(kind)})
    if get_origin(kind) is tuple:
        if name in given:
            return tuple(given[name].reshape(-1).tolist())
        return tuple(decoded(item, given, f"{name}.{k}") for k, item in enumerate(get_args(kind)))
    if _is_mapping(kind):
        item = get_args(kind)[1]
        keys = [key[len(name) + 1 :] for key in given if key.startswith(f"{name}.")]
        return {key: decoded(item, given, f"{name}.{key}") for key in keys}
    if kind == list[list[int]]:
        items, ends = (_whole(given[f"{name}.{part}"], f"{name}.{part}") for part in ("items", "ends"))
        return [part.tolist() for part in np.split(items, ends)[: len(ends)]]
    value = given[name]
    return _of_text(kind, value) if isinstance(value, str) else _of_array(kind, value, name)


def _of_text(kind: Any, text: str) -> Any:
    if kind in (int, float):
        return kind(text)
    return bool(int(text)) if kind is bool else text


def _of_array(kind: Any, value: np.ndarray, name: str) -> Any:
    if kind in (int, float, bool):
        if value.size != 1:
            raise ValueError(f"{name} has shape {list(value.shape)}; it must be one number, []")
        return kind(value.item() if kind is float else _whole(value, name).item())
    if kind in (list[float], list[int]):
        return (value if kind == list[float] else _whole(value, name)).reshape(-1).tolist()
    if "bool" in _dtype_of(kind):
        return _whole(value, name).astype(bool)
    return _whole(value, name) if "int" in _dtype_of(kind) else value


def _whole(value: np.ndarray, name: str) -> np.ndarray:
    known = np.where(np.isfinite(value), value, 0.5)
    if np.any(known != np.round(known)):
        raise ValueError(f"{name} are not whole numbers")
    return known.astype(np.int64)


def _is_part(key: str, name: str) -> bool:
    return key == name or key.startswith(f"{name}.")


def _without_none(kind: Any) -> tuple[Any, bool]:
    if get_origin(kind) not in (Union, UnionType):
        return kind, False
    rest = [each for each in get_args(kind) if each is not NoneType]
    return (rest[0] if len(rest) == 1 else kind), len(rest) < len(get_args(kind))


def _record(kind: Any) -> tuple[str, ...]:
    """Return the names of a record's fields; none where a type is no record."""
    return tuple(f.name for f in fields(kind)) if is_dataclass(kind) else getattr(kind, "_fields", ())


def _is_mapping(kind: Any) -> bool:
    origin = get_origin(kind)
    return inspect.isclass(origin) and issubclass(origin, Mapping)


def _dtype_of(kind: Any) -> str:
    # jaxtyping's classes name the types that an array may have
    return " ".join(getattr(kind, "dtypes", ()))


def _crosses(kind: Any, back: bool) -> bool:
    """Tell whether values of a type can be sent, or read back."""
    kind, _ = _without_none(kind)
    if _record(kind):
        return all(_crosses(get_type_hints(kind)[field], back) for field in _record(kind))
    parts = get_args(kind)
    if get_origin(kind) is tuple:
        return ... not in parts and all(_crosses(each, back) for each in parts)
    if _is_mapping(kind):
        return parts[0] is str and _crosses(parts[1], back)
    if kind in (int, float, bool, np.ndarray, list[list[int]], list[float], list[int]) or hasattr(kind, "dtypes"):
        return True
    return not back and (kind is str or get_origin(kind) in (Literal, Callable) or kind == Callable[[int], np.ndarray])


@functools.cache
def signature_of(name: str) -> tuple[inspect.Signature, Any] | None:
    """Return the signature and the type of the result of a stage function; None where they do not cross to a program.

    Args:
        name: the oracle's.
    """
    function = stage_function("pop_ref", name)
    if function is None or name.startswith("_"):
        return None
    hints = get_type_hints(function)
    result = hints.pop("return")
    crosses = all(map(_is_sent, hints.values())) and _crosses(result, back=True)
    return (inspect.signature(function), result) if crosses else None


def _is_sent(kind: Any) -> bool:
    if get_origin(kind) in (Union, UnionType):
        return all(each is NoneType or _is_sent(each) for each in get_args(kind))
    return _crosses(kind, back=False) or get_args(kind) in ((float,), (int,))


def shape_of(word: str) -> tuple[int, ...]:
    """Return the shape that a word of an answer states.

    Raises:
        ValueError: it states none, or one of more than 2^27 values.
    """
    inner = word.removeprefix("[").removesuffix("]")
    if f"[{inner}]" != word:
        raise ValueError(f"{word!r} is no shape such as [3,4]")
    try:
        shape = tuple(int(side) for side in inner.split(",")) if inner else ()
    except ValueError:
        raise ValueError(f"{word!r} is no shape such as [3,4]") from None
    if any(side < 0 for side in shape) or math.prod(shape) > 1 << 27:
        raise ValueError(f"{word!r} is no shape of an answer")
    return shape
