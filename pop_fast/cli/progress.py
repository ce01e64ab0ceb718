"""Progress of work that reports (stage, done, total): a bar in a terminal, elsewhere a line every half minute."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from pop_fast.io.heartbeat import Heartbeat

Report = Callable[[str, int, int], None]


@contextmanager
def bars(show: bool = True) -> Iterator[Report]:
    """Show one bar a stage on standard error, or lines where that is no terminal; yields the function to report to."""
    current: dict[str, tqdm] = {}

    def report(stage: str, done: int, total: int) -> None:
        beat.say(f"{stage}: {done:,} of {total:,}")
        if stage not in current:
            _close(current)
            current[stage] = tqdm(total=total, desc=stage, disable=None if show else True, leave=False)
        bar = current[stage]
        bar.total = total
        bar.update(done - bar.n)

    with Heartbeat(show) as beat:
        try:
            yield report
        finally:
            _close(current)


def _close(current: dict[str, tqdm]) -> None:
    for bar in current.values():
        bar.close()
    current.clear()
