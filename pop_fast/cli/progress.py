"""Progress of work that reports (stage, done, total): a bar in a terminal, elsewhere a line every half minute."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from tqdm import tqdm

from pop_fast.io.heartbeat import Heartbeat, duration

# s, before which the first ones say little of the rest
_SURE_AFTER: Final = 1.0
Report = Callable[[str, int, int], None]


@contextmanager
def bars(show: bool = True) -> Iterator[Report]:
    """Show one bar a stage on standard error, or lines where that is no terminal; yields the function to report to."""
    current: dict[str, tqdm] = {}
    began = 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal began
        now = time.monotonic()
        if stage not in current:
            began = now
        beat.say(f"{stage}: {done:,} of {total:,}{_left(now - began, done, total)}")
        if stage not in current:
            _close(current)
            current[stage] = tqdm(total=total, desc=stage, disable=None if show else True, leave=False)
        bar = current[stage]
        bar.total = total
        bar.update(done - bar.n)

    with Heartbeat(show, draw=lambda: [bar.refresh() for bar in tuple(current.values())]) as beat:
        try:
            yield report
        finally:
            _close(current)


def _left(seconds: float, done: int, total: int) -> str:
    """Say how long the rest will take if it takes what the first took; nothing before that is known."""
    if done == 0 or done >= total or seconds < _SURE_AFTER:
        return ""
    return f", {duration(seconds * (total - done) / done)} left"


def _close(current: dict[str, tqdm]) -> None:
    for bar in current.values():
        bar.close()
    current.clear()
