"""Times of calls that take turns, so that a noisy machine is as noisy for each."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any


def turns_ms(runs: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = 3) -> dict[str, float]:
    """Run each call once a turn, in changing order, and time it.

    Args:
        runs: calls by name; the first is what the others are compared with.
        repeats: turns that count.
        warm_up: turns before that.

    Returns:
        The median of each, ms, and as "b / a" the median of the ratios within a turn.
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
    found = {name: 1e3 * statistics.median(times) for name, times in taken.items()}
    for name in names[1:]:
        ratios = [mine / its for mine, its in zip(taken[name], taken[names[0]], strict=True)]
        found[f"{name} / {names[0]}"] = statistics.median(ratios)
    return found
