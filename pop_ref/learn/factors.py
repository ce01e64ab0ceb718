"""Factors by which a wrong result differs: one number, the number of entries, or an argument."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from pop_ref.learn.student import Call, same

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
