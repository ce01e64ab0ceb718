"""What can be seen of a wrong function from several of its results: one sentence that says one thing.

A mistake that is known by name comes first (`mistakes`). Else, a function that is right on plain inputs is told on
which special ones it is not. Else its results are compared with the oracle's: what is said holds for every wrong
result, so that a factor (one number, the number of entries, or an argument) is one only where the ratio is the same
everywhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_ref.learn.mistakes import explained_by
from pop_ref.learn.mistakes_geometry import with_turned_rotation
from pop_ref.learn.probes import oracle
from pop_ref.learn.student import Call, NotNumbersError, numbers, said, same, where

# what is wrong, the hint, the call that shows it
Diagnosis = tuple[str, str, Call]
_ORDINALS: Final = ("first", "second", "third", "fourth", "fifth", "sixth")
_AXES: Final = {2: "xy", 3: "xyz", 4: "wxyz"}
# of a camera's matrix
_COLUMNS: Final = ("first column", "second column", "third column", "last column, the translation's,")
_LETTERS: Final = {
    "conics_from_covars2d": ("xx", "xy", "yy"),
    "tile_rects": ("x0", "y0", "x1", "y1"),
    "colors_from_sh": ("red", "green", "blue"),
    "conic": ("A", "B", "C"),
    "sh": ("red", "green", "blue"),
}
# what the places of a result are, where each holds the parts of many parameters
_RESULTS: Final = {"adam_step": ("the new value", "the mean m", "the mean v")}
# at which something of this course is held
_LIMITS: Final = (0.0, 0.999, 1.0)
_ALL_BUT: Final = "all but "
# functions of parameters that make matrices
_OF_STACKS: Final = ("rotmats_from_quats", "covars_from_quats_scales", "rotmats_from_quats_vjp")


def diagnose(calls: Sequence[Call], folder: Path) -> Diagnosis:
    """Say what is wrong with a function.

    Args:
        calls: of one function, the wrong ones and the right ones.
        folder: of the student.

    Returns:
        The sentence; a hint, empty if there is none but the formula; the call that the sentence speaks of.
    """
    wrong = [call for call in calls if not call.is_right]
    name = wrong[0].function
    stopped = next((call for call in wrong if call.error), None)
    if stopped is not None and isinstance(stopped.error, NotNumbersError):
        return f"{name} {stopped.error}.", "", stopped
    if stopped is not None and stopped.error is not None:
        sentence = f"{where(stopped.error, folder)}: it stops with {said(stopped.error)}."
        hint = _of_shapes(stopped) or _of_totals(stopped) or "Call it by hand with these numbers."
        return sentence, hint, stopped
    plainly = _misused(name, wrong)
    if plainly:
        return plainly, "", wrong[0]
    mistake = explained_by(calls, oracle())
    if mistake:
        return mistake.sentence, mistake.hint, wrong[0]
    goes_on = next((call for call in wrong if call.raises), None)
    if goes_on is not None and all(call.raises for call in wrong):
        return f"{name} gives a result where {goes_on.words}: it must stop with a ValueError.", "", goes_on
    wrong = [call for call in wrong if not call.raises]
    special = sorted({call.words for call in wrong})
    right_plain = any(call.is_right and not call.words for call in calls)
    if "" not in special and right_plain:
        return f"{name} is right on plain inputs and wrong where {', or where '.join(special[:3])}.", "", wrong[0]
    # those of plain inputs, if one of them is wrong
    wrong = [call for call in wrong if not call.words] or wrong
    return _compared(name, wrong, any(call.is_right for call in calls)), "", wrong[0]


def _of_shapes(call: Call) -> str:
    """Say what the commonest slip with a stack of matrices is, where NumPy says that shapes do not fit."""
    stacks = any(isinstance(each, np.ndarray) and each.ndim == 3 for each in call.given) or call.function in _OF_STACKS
    if (
        isinstance(call.error, ValueError)
        and stacks
        and ("broadcast" in str(call.error) or "matmul" in str(call.error))
    ):
        return "`.T` of a stack of matrices turns all of its axes round; of each matrix it is `np.swapaxes(M, 1, 2)`."
    return ""


def _of_totals(call: Call) -> str:
    """Say how totals are added to, where Python says that a record's field cannot be set."""
    if isinstance(call.error, AttributeError) and "set attribute" in str(call.error) and "totals" in call.parameters:
        return "The fields of `totals` are arrays that stay: add in place, as in `totals.v_background[:] += x`."
    return ""


def _misused(name: str, wrong: Sequence[Call]) -> str:
    """Name what no number shows: nothing returned, an argument changed, or one that is not."""
    for call in wrong:
        (found, changed), (expected, meant) = call.found, call.expected
        if found is None and expected is not None:
            return f"{name} returns nothing: is a return missing?"
        if call.wanted.startswith("the keys") and not call.words:
            return f"{name} gives a dictionary with other keys: {call.wanted} are asked for."
        if call.wanted == "truth values" or (call.wanted == "whole numbers" and same(call.found, call.expected)):
            how = {"truth values": "compare, as in x > 0", "whole numbers": "write int(x), or x.astype(int)"}
            return f"{name} gives other numbers where {call.wanted} are asked for: {how[call.wanted]}."
        if _of_lists(expected) and not _of_lists(found) and found != []:
            return f"{name} must give a list of lists, one a tile: write list(x), or x.tolist(), for what is none."
        if changed and not meant:
            return f"{name} changes its argument in place; work on a copy, the caller still needs what it gave."
        if meant and not changed:
            return f"{name} changes nothing: it must add to the totals that it is given, with += or [i] +=."
    return ""


def _compared(name: str, wrong: Sequence[Call], some_right: bool) -> str:
    """Compare results part by part, then entry by entry."""
    parts: dict[str, list[Pair]] = {}
    for call in wrong:
        found, expected = leaves(call.found), leaves(call.expected)
        if len(found) != len(expected):
            many = "result is" if len(expected) == 1 else "results are"
            return f"{name} gives {len(found)} results where {len(expected)} {many} asked for."
        shapes = [[each.shape for _, each in made] for made in (found, expected)]
        if shapes[0] != shapes[1] and shapes[0] == shapes[1][::-1]:
            return f"{name} gives its results in the wrong order: they are exchanged."
        for part, (_, a), (_, b) in zip(parts_named(name, call), found, expected, strict=True):
            if a.shape != b.shape and _of_lists(call.expected[0]):
                return _lists_of_another_length(name, call)
            if a.shape != b.shape:
                if part == "`ids`":
                    return f"{name} blends another number of splats, {len(a)} and not {len(b)}{_where_of(call)}."
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
    at = [k for k, part in enumerate(parts) if part in bad]
    truths = all(_is_truth(call.expected if of_all else _taken(call.expected[0], at, len(parts))) for call in wrong)
    named = _together(list(bad))
    subject = name if of_all else f"{' and '.join(named)} {'of' if 'result' in named[0] else 'in'} {name}"
    pairs = [pair for each in bad.values() for pair in each]
    sizes = [max((each.size for each in call.given if isinstance(each, np.ndarray)), default=1) for call in wrong]
    part = "" if of_all else re.sub("the cotangent of |`", "", named[0]).removeprefix("v_").rstrip("s")
    letters = _LETTERS.get(part, _LETTERS.get(name.removesuffix("_vjp"), ()) if of_all else ())
    what = _as_a_whole(pairs, sizes, some_right, truths)
    if not what and all(len(parts[part]) == len(wrong) for part in bad):
        factors = {factor_of_an_argument(wrong, parts[part]) for part in bad}
        what = factors.pop() if len(factors) == 1 else ""
    what = what or _in_places(pairs, letters) or _off_by(pairs)
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
    results = {part.rpartition("` of ")[2] for part in parts}
    if len(parts) > 1 and len(results) == 1:
        return list(results)
    if len(parts) <= 3:
        return parts
    named = list(dict.fromkeys(re.sub(r"`([^.`]*)[^`]*`", r"`\1`", part) for part in parts))
    return named if len(named) <= 3 else [*named[:2], f"{len(named) - 2} more parts"]


def parts_named(name: str, call: Call) -> list[str]:
    """Name the leaves of a result: by its place and fields, by what the docstring's "Returns" quotes, or by place."""
    parts = leaves(call.expected)
    stated = re.search(r"Returns:\n(.*?)(?:\n\n|\Z)", oracle()[name].__doc__ or "", re.DOTALL)
    quoted = re.findall(r"`(\w+)`", stated[1]) if stated else []
    if len(quoted) >= len(parts) > 1 and name.endswith("_vjp"):
        return [f"the cotangent of `{each}`" for each in quoted[: len(parts)]]
    returned = call.expected[0]
    each = returned if type(returned) is tuple else (returned,)
    places = [k for k, result in enumerate(each) for _ in leaves(result, depth=1)]
    places += [len(each)] * (len(parts) - len(places))
    if name in _RESULTS and len(each) == len(_RESULTS[name]):
        return [_RESULTS[name][k] for k in places]
    named = [f"the {_ORDINALS[min(k, 5)]} result" for k in places]
    labels = [label for label, _ in parts]
    return [
        f"`{label}`{f' of {place}' if labels.count(label) > 1 else ''}" if label else place
        for place, label in zip(named, labels, strict=True)
    ]


def _is_truth(value: Any) -> bool:
    """Tell that a result, or a part of it, is made of truth values alone."""
    if isinstance(value, tuple | list):
        kept = [each for each in value if not (isinstance(each, tuple) and not each)]
        return bool(kept) and all(map(_is_truth, kept))
    return isinstance(value, bool | np.bool_) or (isinstance(value, np.ndarray) and value.dtype == bool)


def _taken(returned: Any, at: Sequence[int], n: int) -> Any:
    """Take some of a result's parts, if each of its n parts is a value by itself."""
    return tuple(returned[k] for k in at) if type(returned) is tuple and len(returned) == n else None


def _of_lists(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(each, list) for each in value)


def _lists_of_another_length(name: str, call: Call) -> str:
    """Compare lists of one tile each, which are flattened to be compared."""
    found, expected = call.found[0], call.expected[0]
    if not _of_lists(found) or len(found) != len(expected):
        n = len(found) if hasattr(found, "__len__") else "no"
        return f"{name} gives {n} lists where {len(expected)} are asked for, one a tile{_where_of(call)}."
    if len(found) > 1 and all(each is found[0] for each in found):
        return f"In {name} all lists are one and the same list: [[]] * n repeats it; write [[] for _ in range(n)]."
    k = next(k for k, (a, b) in enumerate(zip(found, expected, strict=True)) if len(a) != len(b))
    return f"{name} lists {len(found[k])} splats in tile {k} where {len(expected[k])} are asked for{_where_of(call)}."


def leaves(value: Any, label: str = "", depth: int = 0) -> list[tuple[str, np.ndarray]]:
    """Take a result apart into arrays, with the names of their fields."""
    if value is None:
        return []
    if depth > 1 and isinstance(value, tuple) and value and all(np.ndim(each) == 0 for each in value):
        return [(label, numbers(value))]
    if isinstance(value, dict):
        return [leaf for key in sorted(value, key=str) for leaf in leaves(value[key], f"{label}.{key}".strip("."))]
    fields = getattr(value, "_fields", None) or list(getattr(value, "__dataclass_fields__", ()))
    if fields:
        return [leaf for key in fields for leaf in leaves(getattr(value, key), f"{label}.{key}".strip("."))]
    if isinstance(value, tuple) or (isinstance(value, list) and any(isinstance(x, np.ndarray) for x in value)):
        return [leaf for each in value for leaf in leaves(each, label, depth + 1)]
    return [(label, numbers(value) if isinstance(value, list) else np.asarray(value, dtype=np.float64))]


def _as_a_whole(
    pairs: Sequence[Pair], sizes: Sequence[int] = (), some_right: bool = False, truths: bool = False
) -> str:
    """Say what is the same about every wrong result, of found and expected; empty if nothing is."""

    def always(made: Any) -> bool:
        with np.errstate(all="ignore"):
            return all(a.shape == np.shape(made(b)) and same(a, made(b)) for a, b in pairs)

    found, expected = (np.concatenate([np.ravel(pair[k]) for pair in pairs]) for k in (0, 1))
    if truths and set(np.unique(found)) <= {0.0, 1.0}:
        return _of_a_mask(found, expected, some_right)
    if not np.any(found) and np.any(expected):
        return "is always 0: it is not filled, or a term is missing"
    if always(lambda b: -b):
        return "has the wrong sign"
    factor = one_factor(found, expected)
    if factor:
        return factor
    if np.ptp(found - expected) < 1e-9 * max(1.0, np.max(np.abs(expected))) and len(found) > 1:
        return _offset(float(np.mean(found - expected)), "on some inputs" if some_right else "everywhere")
    if all(b.ndim >= 2 and b.shape[-1] == b.shape[-2] for _, b in pairs):
        if always(lambda b: np.swapaxes(b, -1, -2)):
            return "is transposed: rows stand for columns"
        if all(b.shape == (4, 4) for _, b in pairs) and always(with_turned_rotation):
            return "has its rotation, the first three rows and columns, transposed"
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
    return _of_rounding(found, expected) or per_input(pairs, sizes)


def _of_a_mask(found: np.ndarray, expected: np.ndarray, some_right: bool) -> str:
    both = len(np.unique(expected)) == 2 or not some_right
    if np.array_equal(found, 1.0 - expected) and both:
        return "is the wrong way round: yes stands for no"
    if np.all(found >= expected):
        return "says yes too often; is a condition missing, or its bound too wide or inclusive?"
    if np.all(found <= expected):
        return "says yes too rarely; is a condition too strict, or `and` written for `or`?"
    return ""


def _offset(by: float, where_: str) -> str:
    if abs(abs(by) - 0.5) < 1e-9:
        return f"is {by:+.4g} off {where_}, by half: pixel centres lie at index + 0.5"
    if abs(abs(by) - 1.0) < 1e-9:
        return f"is off by one {where_} ({by:+.4g})"
    return f"is {by:+.6g} off {where_}: a constant is added, or one is missing"


def _of_rounding(found: np.ndarray, expected: np.ndarray) -> str:
    whole = np.array_equal(found, np.round(found))
    if whole and np.array_equal(expected, np.round(expected)):
        off = set(np.unique(found - expected))
        if off <= {-1.0, 0.0}:
            return "is one too small for some inputs: it is rounded down or to the nearest where it must be rounded up"
        if off <= {0.0, 1.0}:
            return "is one too large for some inputs: it is off by one, or rounded up where it must be rounded down"
        return ""
    rounded = any(np.array_equal(found, way(expected)) for way in (np.round, np.floor, np.ceil))
    # one number alone may be a limit
    if rounded and len(np.unique(found)) > 1:
        return "is rounded to whole numbers; keep the fractions"
    size = np.max(np.abs(expected))
    error = float(np.max(np.abs(found - expected)))
    if size > 0.0 and error < 1e-3 * size:
        why = "something small, such as an epsilon, is added or missing, or a constant is rounded"
        why += ", or it is computed in float32" if error < 1e-6 * size else ""
        return f"is right to {max(int(-np.log10(error / size)), 1)} digits and no further: {why}"
    return ""


def _in_places(pairs: Sequence[Pair], letters: Sequence[str]) -> str:
    """Say which entries are wrong, if it is the same ones in every result, and what is wrong with those."""
    held = _clamped(pairs)
    if held:
        return held
    for places, label in _places(pairs, letters):
        only = [(a[place], b[place]) for (a, b), place in zip(pairs, places, strict=True)]
        others = [(a[~place], b[~place]) for (a, b), place in zip(pairs, places, strict=True)]
        if all(same(*pair) for pair in others) and any(len(b) for _, b in others):
            what = _as_a_whole(only) or _off_by(only)
            if label.startswith(_ALL_BUT):
                if _mostly_right(pairs, places):
                    continue
                return f"is right in {label.removeprefix(_ALL_BUT)} only; elsewhere it {what}"
            return f"is wrong in {label} only, which {what}"
    return ""


def _mostly_right(pairs: Sequence[Pair], places: Sequence[np.ndarray]) -> bool:
    """Tell that more than a tenth of the entries at some places are right: it is not the place that is wrong."""
    wrong = [np.abs(a - b)[place] > 1e-9 for (a, b), place in zip(pairs, places, strict=True)]
    return float(np.mean(np.concatenate(wrong))) < 0.9


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
        names = _COLUMNS if set(shapes) == {(4, 4)} else names
        for k in range(last):
            label = f"the {names[k]}" if names else f"number {k} of each row"
            yield [_at(shape, (..., k)) for shape in shapes], f"column {k} of each matrix" if least == 3 else label
        for k in range(last if last in (3, 4) else 0):
            label = f"the {names[k]}" if names else f"number {k}"
            yield [~_at(shape, (..., k)) for shape in shapes], f"{_ALL_BUT}{label}"
    if least == 3 and all(shape[-1] == shape[-2] for shape in shapes):
        eye = [np.broadcast_to(np.eye(shape[-1], dtype=bool), shape) for shape in shapes]
        yield [~each for each in eye], "the entries off the diagonal"
        yield list(eye), "the diagonal"
    if least == 3 and len({shape[-2] for shape in shapes}) == 1:
        for k in range(shapes[0][-2]):
            yield [_at(shape, (..., k, slice(None))) for shape in shapes], f"row {k} of each matrix"
    if all(shape[0] > 1 for shape in shapes):
        yield [~_at(shape, 0) for shape in shapes], f"{_ALL_BUT}the first row"


def _at(shape: tuple[int, ...], where: Any) -> np.ndarray:
    mask = np.zeros(shape, dtype=bool)
    mask[where] = True
    return mask


def _clamped(pairs: Sequence[Pair]) -> str:
    """See that what is wrong should all be one number and goes past it to one side, or is one and should go past it."""
    off = [(a[np.abs(a - b) > 1e-9], b[np.abs(a - b) > 1e-9]) for a, b in pairs if a.shape == b.shape]
    found, expected = (np.concatenate([np.ravel(pair[k]) for pair in off]) for k in (0, 1))
    one = len(expected) and np.ptp(expected) < 1e-12 and float(expected[0]) in _LIMITS
    if one and (np.all(found > expected) or np.all(found < expected)):
        side = "above" if np.all(found > expected) else "below"
        return f"goes {side} {expected[0]:.4g}, where it must be held: a limit (min or max) is missing"
    held = len(found) > 1 and np.all(found == 1.0) and np.any(expected != np.round(expected))
    if held and np.all(expected > found):
        return "is held at 1 where it should go above it: a limit (min or max) is one too many"
    return ""


def _off_by(pairs: Sequence[Pair]) -> str:
    # of the call that is shown
    a, b = (np.ravel(each) for each in next(pair for pair in pairs if pair[0].size))
    at = int(np.argmax(np.abs(a - b)))
    # so many digits that they differ
    digits = next((n for n in range(4, 17) if f"{a[at]:.{n}g}" != f"{b[at]:.{n}g}"), 17)
    return f"is not right yet: {a[at]:.{digits}g} where {b[at]:.{digits}g} is asked for"


# found and expected
Pair = tuple[np.ndarray, np.ndarray]
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
# to which power an argument is a factor of what was found
_POWERS: Final = (
    (-1, "lacks the factor {}"),
    (1, "has the factor {}, which does not belong there, or has it twice"),
    (-2, "lacks the factor {}, twice"),
    (2, "has the factor {} twice too often"),
)


def one_factor(found: np.ndarray, expected: np.ndarray) -> str:
    """Find the one ratio of all entries; empty if there is none."""
    nonzero = np.abs(expected) > 1e-12
    if np.sum(nonzero) < 2 or not np.allclose(found[~nonzero], 0.0, atol=1e-9):
        return ""
    ratios = found[nonzero] / expected[nonzero]
    if np.ptp(ratios) > 1e-6 * np.max(np.abs(ratios)):
        return ""
    ratio = float(np.mean(ratios))
    if abs(abs(ratio) - 1.0) < 1e-6:
        # that is rounding
        return ""
    why = next((why for each, why in _FACTORS.items() if abs(abs(ratio) - each) < 1e-6 * each), "a factor is wrong")
    sign = " and the sign is wrong, too" if ratio < 0 else ""
    return f"is {abs(ratio):.4g} times what it should be, everywhere: {why}{sign}"


def per_input(pairs: Sequence[Pair], sizes: Sequence[int]) -> str:
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


def factor_of_an_argument(calls: Sequence[Call], pairs: Sequence[Pair]) -> str:
    """Find an argument that is a factor too many or too few of every result; empty if there is none.

    Args:
        calls: of one function.
        pairs: found and expected, one a call.
    """
    for place, name in enumerate(calls[0].parameters):
        for length in (False, True):
            factors = [
                _spread(call.given[place], b, length) if place < len(call.given) else None
                for call, (_, b) in zip(calls, pairs, strict=True)
            ]
            taken = [each for each in factors if each is not None]
            if len(taken) < len(factors) or all(np.allclose(each, 1.0) for each in taken):
                continue
            for power, words in _POWERS:
                with np.errstate(all="ignore"):
                    made = [b * each**power for each, (_, b) in zip(taken, pairs, strict=True)]
                if all(same(a, each) for each, (a, _) in zip(made, pairs, strict=True)):
                    return words.format(f"|{name}|, the length of each row" if length else f"`{name}`")
    return ""


def _spread(value: Any, result: np.ndarray, length: bool) -> np.ndarray | None:
    """Spread an argument over a result: a number, one number a row, or each row's length."""
    rows = np.asarray(value) if isinstance(value, float | int | np.ndarray) and not isinstance(value, bool) else None
    if rows is None or rows.dtype == bool or not np.all(np.isfinite(rows)):
        return None
    if rows.ndim == 2 and length:
        rows = np.linalg.norm(rows, axis=1)
    elif length:
        return None
    if rows.shape == result.shape and not length:
        return rows.astype(np.float64)
    if rows.ndim == 0:
        return np.full(result.shape, float(rows))
    if rows.ndim != 1 or result.ndim == 0 or len(rows) != len(result):
        return None
    return np.broadcast_to(rows.reshape(-1, *[1] * (result.ndim - 1)), result.shape).astype(np.float64)
