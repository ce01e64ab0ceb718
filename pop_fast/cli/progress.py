"""A progress bar for work that reports (stage, done, total)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

Report = Callable[[str, int, int], None]


@contextmanager
def bars(show: bool = True) -> Iterator[Report]:
    """Show one bar a stage on standard error when it is a terminal; yields the function to report to."""
    current: dict[str, tqdm] = {}

    def report(stage: str, done: int, total: int) -> None:
        if stage not in current:
            _close(current)
            current[stage] = tqdm(total=total, desc=stage, disable=None if show else True, leave=False)
        bar = current[stage]
        bar.total = total
        bar.update(done - bar.n)

    try:
        yield report
    finally:
        _close(current)


def _close(current: dict[str, tqdm]) -> None:
    for bar in current.values():
        bar.close()
    current.clear()
