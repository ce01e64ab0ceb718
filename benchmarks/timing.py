"""Times of calls that take turns, so that a noisy machine is as noisy for each."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any


def turns(runs: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 3) -> dict[str, list[float]]:
    """Run each call once a turn, in changing order, and time it.

    Args:
        runs: calls by name.
        repeats: turns that count.
        warm_up: turns before that.

    Returns:
        The seconds of each, turn by turn.
    """
    names = list(runs)
    taken: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(warm_up + repeats):
        for name in names if turn % 2 else reversed(names):
            start = time.perf_counter()
            runs[name]()
            seconds = time.perf_counter() - start
            if turn >= warm_up:
                taken[name].append(seconds)
    return taken


def turns_ms(runs: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 3) -> dict[str, float]:
    """Time calls in turns as `turns` does; the first is what the others are compared with.

    Returns:
        The median of each, ms, and as "b / a" the median of the ratios within a turn.
    """
    names, taken = list(runs), turns(runs, repeats, warm_up)
    found = {name: 1e3 * statistics.median(times) for name, times in taken.items()}
    for name in names[1:]:
        found[f"{name} / {names[0]}"] = median_ratio(taken[name], taken[names[0]])
    return found


def median_ratio(mine: Sequence[float], its: Sequence[float]) -> float:
    """Return the median of the ratios within a turn."""
    return statistics.median(a / b for a, b in zip(mine, its, strict=True))
