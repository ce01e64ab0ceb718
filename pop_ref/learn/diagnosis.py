"""What can be seen of a wrong function from several of its results: one sentence that says one thing.

A mistake that is known by name comes first (`mistakes`). Else, a function that is right on plain inputs is told on
which special ones it is not. Else its results are compared with the oracle's: what is said holds for every wrong
result, so that a factor is a factor only where the ratio is the same everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes import explained_by
from pop_ref.learn.probes import oracle
from pop_ref.learn.student import Call, numbers, said, same, where

Pair = tuple[np.ndarray, np.ndarray]
_ORDINALS: Final = ("first", "second", "third", "fourth", "fifth", "sixth")
_AXES: Final = {2: "xy", 3: "xyz", 4: "wxyz"}
_LETTERS: Final = {"conics_from_covars2d": ("xx", "xy", "yy"), "tile_rects": ("x0", "y0", "x1", "y1")}
_FACTORS: Final = {
    2.0: "a 2 is one too many, or a half is missing",
    0.5: "a 2 is missing, or a half is one too many",
    4.0: "a 2 is squared that should not be, or a quarter is missing",
    0.25: "a factor of 4 is missing",
    180.0 / np.pi: "it is in degrees, and radians are asked for",
    np.pi / 180.0: "an angle is turned into radians that is in radians already",
    255.0: "it counts in steps of a byte, and shares from 0 to 1 are asked for",
    1.0 / 255.0: "it is divided by 255 once too often",
}


def diagnose(calls: Sequence[Call], folder: Path) -> tuple[str, str]:
    """Say what is wrong with a function.

    Args:
        calls: of one function, the wrong ones and the right ones.
        folder: of the student.

    Returns:
        The sentence; a hint, empty if there is none but the formula.
    """
    wrong = [call for call in calls if not call.is_right]
    name = wrong[0].function
    error = next((call.error for call in wrong if call.error), None)
    if error is not None:
        return f"{where(error, folder)}: it stops with {said(error)}.", "Call it by hand with these numbers."
    plainly = _misused(name, wrong)
    if plainly:
        return plainly, ""
    mistake = explained_by(calls, oracle())
    if mistake:
        return mistake.sentence, mistake.hint
    special = sorted({call.words for call in wrong})
    right_plain = any(call.is_right and not call.words for call in calls)
    if "" not in special and right_plain:
        return f"{name} is right on plain inputs and wrong where {', or where '.join(special[:3])}.", ""
    return _compared(name, wrong, right_plain), ""


def _misused(name: str, wrong: Sequence[Call]) -> str:
    """Name what no number shows: nothing returned, an argument changed, or one that is not."""
    for call in wrong:
        (found, changed), (expected, meant) = call.found, call.expected
        if found is None and expected is not None:
            return f"{name} returns nothing: is a return missing?"
        if changed and not meant:
            return f"{name} changes its argument in place; work on a copy, the caller still needs what it gave."
        if meant and not changed:
            return f"{name} changes nothing: it must add to the totals that it is given, with += or [i] +=."
    return ""


def _compared(name: str, wrong: Sequence[Call], some_right: bool) -> str:
    """Compare results part by part, then entry by entry; those of plain inputs, if one of them is wrong."""
    wrong = [call for call in wrong if not call.words] or wrong
    parts: dict[str, list[Pair]] = {}
    for call in wrong:
        found, expected = leaves(call.found), leaves(call.expected)
        if len(found) != len(expected):
            many = "result is" if len(expected) == 1 else "results are"
            return f"{name} gives {len(found)} results where {len(expected)} {many} asked for."
        for part, (_, a), (_, b) in zip(_parts_named(name, call), found, expected, strict=True):
            if a.shape != b.shape:
                of = "" if len(expected) == 1 else f"{part} of "
                return f"{of}{name} has shape {list(a.shape)} where {list(b.shape)} is asked for{_where_of(call)}."
            if not np.all(np.isfinite(a)) and np.all(np.isfinite(b)):
                return (
                    f"{name} returns a number that is not finite{_where_of(call)}: is something divided by 0, or does"
                    " exp overflow?"
                )
            parts.setdefault(part, []).append((a, b))
    if len(parts) > 1 and _exchanged(parts):
        return f"{name} gives its results in the wrong order: they are exchanged."
    bad = {part: [pair for pair in pairs if not same(*pair)] for part, pairs in parts.items()}
    bad = {part: pairs for part, pairs in bad.items() if pairs}
    of_all = len(bad) == len(parts)
    named = _together(list(bad))
    subject = name if of_all else f"{' and '.join(named)} {'of' if 'result' in named[0] else 'in'} {name}"
    pairs = [pair for each in bad.values() for pair in each]
    sizes = [max((each.size for each in call.given if isinstance(each, np.ndarray)), default=1) for call in wrong]
    letters = _LETTERS.get(name.removesuffix("_vjp"), ())
    what = _as_a_whole(pairs, sizes, some_right) or _in_places(pairs, letters) or _off_by(pairs)
    if not of_all and len(named) > 1:
        what = re.sub("^(is|has|goes) ", lambda verb: {"is": "are ", "has": "have ", "goes": "go "}[verb[1]], what)
    rest = "" if of_all else "; the rest is right"
    return f"{subject} {what}{rest}{'' if what.endswith('?') and not rest else '.'}"


def _where_of(call: Call) -> str:
    return f" where {call.words}" if call.words else ""


def _exchanged(parts: dict[str, list[Pair]]) -> bool:
    each = list(parts.values())
    return all(
        same(a, b)
        for left, right in zip(each, reversed(each), strict=True)
        for (a, _), (_, b) in zip(left, right, strict=False)
    )


def _together(parts: list[str]) -> list[str]:
    """Name at most three parts, by what they have in common if there are more."""
    if len(parts) <= 3:
        return parts
    return list(dict.fromkeys(f"`{part.strip('`').partition('.')[0]}`" for part in parts))[:3]


def _parts_named(name: str, call: Call) -> list[str]:
    """Name the leaves of a result: by its fields, by what the docstring's "Returns" quotes, or by number."""
    parts = leaves(call.expected)
    stated = re.search(r"Returns:\n(.*?)(?:\n\n|\Z)", oracle()[name].__doc__ or "", re.DOTALL)
    quoted = re.findall(r"`(\w+)`", stated[1]) if stated else []
    if len(quoted) == len(parts) > 1:
        return [f"the cotangent of `{each}`" for each in quoted]
    return [f"`{label}`" if label else f"the {_ORDINALS[min(k, 5)]} result" for k, (label, _) in enumerate(parts)]


def leaves(value: Any, label: str = "", depth: int = 0) -> list[tuple[str, np.ndarray]]:
    """Take a result apart into arrays, with the names of their fields."""
    if value is None:
        return []
    if depth > 1 and isinstance(value, tuple) and value and all(np.ndim(each) == 0 for each in value):
        return [(label, numbers(value))]
    if isinstance(value, dict):
        return [leaf for key, each in value.items() for leaf in leaves(each, f"{label}.{key}".strip("."))]
    fields = getattr(value, "_fields", None) or list(getattr(value, "__dataclass_fields__", ()))
    if fields:
        return [leaf for key in fields for leaf in leaves(getattr(value, key), f"{label}.{key}".strip("."))]
    if isinstance(value, tuple) or (isinstance(value, list) and any(isinstance(x, np.ndarray) for x in value)):
        return [leaf for each in value for leaf in leaves(each, label, depth + 1)]
    return [(label, numbers(value) if isinstance(value, list) else np.asarray(value, dtype=np.float64))]


def _as_a_whole(pairs: Sequence[Pair], sizes: Sequence[int] = (), some_right: bool = False) -> str:
    """Say what is the same about every wrong result, of found and expected; empty if nothing is."""

    def always(made: Any) -> bool:
        with np.errstate(all="ignore"):
            return all(a.shape == np.shape(made(b)) and same(a, made(b)) for a, b in pairs)

    found, expected = (np.concatenate([np.ravel(pair[k]) for pair in pairs]) for k in (0, 1))
    if set(np.unique(expected)) <= {0.0, 1.0} and set(np.unique(found)) <= {0.0, 1.0}:
        return _of_a_mask(found, expected, some_right)
    if not np.any(found) and np.any(expected):
        return "is always 0: it is not filled, or a term is missing"
    if always(lambda b: -b):
        return "has the wrong sign"
    factor = _factor(found, expected)
    if factor:
        return factor
    if np.ptp(found - expected) < 1e-9 * max(1.0, np.max(np.abs(expected))) and len(found) > 1:
        return _offset(float(np.mean(found - expected)))
    if all(b.ndim >= 2 and b.shape[-1] == b.shape[-2] for _, b in pairs) and always(lambda b: np.swapaxes(b, -1, -2)):
        return "is transposed: rows stand for columns"
    if all(b.ndim >= 1 and b.shape[-1] > 1 for _, b in pairs):
        if always(lambda b: b[..., ::-1]):
            return "has its numbers in the opposite order: x and y, or first and last, are exchanged"
        for by in (1, -1):
            if always(lambda b, by=by: np.roll(b, by, axis=-1)):
                return "has its numbers shifted by one place: the first stands last, or the last first"
    for made, what in (
        (np.abs, "has lost its sign: it is the absolute value of what it should be"),
        (np.square, "is the square of what it should be"),
        (lambda b: np.sqrt(np.abs(b)), "is the root of what it should be"),
        (lambda b: 1.0 / np.where(b == 0.0, np.nan, b), "is one over what it should be"),
        (np.exp, "is the exponential of what it should be"),
    ):
        if always(made):
            return what
    return _of_rounding(found, expected) or _per_input(pairs, sizes)


def _of_a_mask(found: np.ndarray, expected: np.ndarray, some_right: bool) -> str:
    if np.array_equal(found, 1.0 - expected) and not some_right:
        return "is the wrong way round: yes stands for no"
    if np.all(found >= expected):
        return "says yes too often; is a condition missing, or its bound too wide or inclusive?"
    if np.all(found <= expected):
        return "says yes too rarely; is a condition too strict, or `and` written for `or`?"
    return ""


def _factor(found: np.ndarray, expected: np.ndarray) -> str:
    nonzero = np.abs(expected) > 1e-12
    if np.sum(nonzero) < 2 or not np.allclose(found[~nonzero], 0.0, atol=1e-9):
        return ""
    ratios = found[nonzero] / expected[nonzero]
    if np.ptp(ratios) > 1e-6 * np.max(np.abs(ratios)):
        return ""
    ratio = float(np.mean(ratios))
    why = next((why for each, why in _FACTORS.items() if abs(abs(ratio) - each) < 1e-6 * each), "a factor is wrong")
    sign = " and the sign is wrong, too" if ratio < 0 else ""
    return f"is {abs(ratio):.4g} times what it should be, everywhere: {why}{sign}"


def _offset(by: float) -> str:
    if abs(abs(by) - 0.5) < 1e-9:
        return f"is {by:+.4g} off everywhere, by half: pixel centres lie at index + 0.5"
    if abs(abs(by) - 1.0) < 1e-9:
        return f"is off by one everywhere ({by:+.4g})"
    return f"is {by:+.6g} off everywhere: a constant is added, or one is missing"


def _of_rounding(found: np.ndarray, expected: np.ndarray) -> str:
    whole = np.array_equal(found, np.round(found))
    if whole and np.array_equal(expected, np.round(expected)):
        off = set(np.unique(found - expected))
        if off <= {-1.0, 0.0}:
            return "is one too small for some inputs: it is rounded down or to the nearest where it must be rounded up"
        if off <= {0.0, 1.0}:
            return "is one too large for some inputs: it is off by one, or rounded up where it must be rounded down"
        return ""
    if whole and np.max(np.abs(found - expected)) <= 1.0:
        return "is rounded to whole numbers; keep the fractions"
    size = np.max(np.abs(expected))
    error = float(np.max(np.abs(found - expected)))
    if size > 0.0 and error < 1e-3 * size:
        return (
            f"is right to {max(int(-np.log10(error / size)), 1)} digits and no further: something small, such as an "
            "epsilon, is added or missing, or a constant is rounded"
        )
    return ""


def _per_input(pairs: Sequence[Pair], sizes: Sequence[int]) -> str:
    """Find a factor that is the number of entries: a sum where a mean is asked for, or the reverse."""
    if len(pairs) != len(sizes) or len(set(sizes)) < 2:
        return ""
    with np.errstate(all="ignore"):
        ratios = [np.ravel(a) / np.ravel(b) for a, b in pairs]
    kept = [(r[np.isfinite(r)], n) for r, n in zip(ratios, sizes, strict=True) if np.any(np.isfinite(r))]
    if len(kept) < 2 or any(np.ptp(r) > 1e-6 * np.max(np.abs(r)) for r, _ in kept):
        return ""
    by, entries = np.array([r[0] for r, _ in kept]), np.array([float(n) for _, n in kept])
    if np.allclose(by, entries, rtol=1e-6):
        return "is a sum, and a mean is asked for: divide by the number of entries"
    if np.allclose(by * entries, 1.0, rtol=1e-6):
        return "is divided by the number of entries once too often"
    return ""


def _in_places(pairs: Sequence[Pair], letters: Sequence[str]) -> str:
    """Say which entries are wrong, if it is the same ones in every result, and what is wrong with those."""
    for places, label in _places(pairs, letters):
        only = [(a[place], b[place]) for (a, b), place in zip(pairs, places, strict=True)]
        others = [(a[~place], b[~place]) for (a, b), place in zip(pairs, places, strict=True)]
        if all(same(*pair) for pair in others) and any(len(b) for _, b in others):
            what = _as_a_whole(only) or _off_by(only)
            return f"is wrong in {label}{'' if label.startswith('all') else ' only'}, which {what}"
    return _clamped(pairs)


def _places(pairs: Sequence[Pair], letters: Sequence[str]) -> Iterator[tuple[list[np.ndarray], str]]:
    """Go through sets of entries that may be the only wrong ones, small sets first."""
    shapes = [b.shape for _, b in pairs]
    least = min(map(len, shapes))
    if not least or {len(shape) for shape in shapes} != {least}:
        return
    last = shapes[0][-1]
    flags = all(set(np.unique(b)) <= {0.0, 1.0} for _, b in pairs)
    if all(shape[-1] == last for shape in shapes) and not (least == 1 and flags):
        names = letters if len(letters) == last else _AXES.get(last, "")
        for k in range(last):
            label = f"the {names[k]}" if names else f"number {k} of each row"
            yield [_at(shape, (..., k)) for shape in shapes], f"column {k} of each matrix" if least == 3 else label
        for k in range(last if last in (3, 4) else 0):
            label = f"the {names[k]}" if names else f"number {k}"
            yield [~_at(shape, (..., k)) for shape in shapes], f"all but {label}"
    if least == 3 and all(shape[-1] == shape[-2] for shape in shapes):
        eye = [np.broadcast_to(np.eye(shape[-1], dtype=bool), shape) for shape in shapes]
        yield [~each for each in eye], "the entries off the diagonal"
        yield list(eye), "the diagonal"
    if least == 3 and len({shape[-2] for shape in shapes}) == 1:
        for k in range(shapes[0][-2]):
            yield [_at(shape, (..., k, slice(None))) for shape in shapes], f"row {k} of each matrix"
    if all(shape[0] > 1 for shape in shapes):
        yield [~_at(shape, 0) for shape in shapes], "all rows but the first"


def _at(shape: tuple[int, ...], where: Any) -> np.ndarray:
    mask = np.zeros(shape, dtype=bool)
    mask[where] = True
    return mask


def _clamped(pairs: Sequence[Pair]) -> str:
    """See that what is wrong should all be one number, and goes past it to one side."""
    off = [(a[np.abs(a - b) > 1e-9], b[np.abs(a - b) > 1e-9]) for a, b in pairs if a.shape == b.shape]
    found, expected = (np.concatenate([np.ravel(pair[k]) for pair in off]) for k in (0, 1))
    if len(expected) and np.ptp(expected) < 1e-12 and (np.all(found > expected) or np.all(found < expected)):
        side = "above" if np.all(found > expected) else "below"
        return f"goes {side} {expected[0]:.4g}, where it must be held: a limit (min or max) is missing"
    return ""


def _off_by(pairs: Sequence[Pair]) -> str:
    k = int(np.argmax([np.max(np.abs(a - b)) / (np.max(np.abs(b)) + 1e-12) if a.size else 0.0 for a, b in pairs]))
    a, b = (np.ravel(each) for each in pairs[k])
    at = int(np.argmax(np.abs(a - b)))
    return f"is not right yet: {a[at]:.4g} where {b[at]:.4g} is asked for"
