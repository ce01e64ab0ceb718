"""A sign of life while long work runs: a bar and its clock in a terminal, elsewhere a line every half minute."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tqdm import tqdm

# seconds between two lines, and between two looks of a bar
PERIOD: Final = 30.0
TICK: Final = 1.0


class Heartbeat:
    """Tell on standard error what is being done, while the block runs; in a terminal, draw its bar anew.

    A thread of its own does it, so that a line also comes from within one long computation, and a bar's clock goes on.

    Args:
        show: False tells nothing.
        period: seconds between two lines; None takes `PERIOD`.
        draw: called every `TICK` seconds in a terminal, where no line is told.

    Example:
        with Heartbeat() as beat:
            for done, photograph in enumerate(photographs):
                beat.say(f"reading photographs: {done} of {len(photographs)}")
    """

    def __init__(
        self, show: bool = True, period: float | None = None, draw: Callable[[], object] | None = None
    ) -> None:
        self._period = PERIOD if period is None else period
        # pythonw and some notebooks have no such stream
        stream = sys.stderr if show else None
        self._does = None if stream is None else self._tell
        if stream is not None and stream.isatty():
            self._does, self._period = draw, TICK
        self._text = ""
        self._started = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)

    def say(self, text: str) -> None:
        self._text = text

    def __enter__(self) -> Heartbeat:
        self._started = time.monotonic()
        if self._does is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._does is not None:
            self._thread.join()

    def _beat(self) -> None:
        while self._does is not None and not self._over.wait(self._period):
            self._does()

    def _tell(self) -> None:
        if self._text:
            took = duration(time.monotonic() - self._started)
            print(f"pop: {self._text} ({took})", file=sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """Write a time as people say it: 42 s, 3 min 5 s, 2 h 10 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


class Pace:
    """How fast the latest steps were, over half a minute: the first steps have fewer Gaussians or smaller pictures.

    Args:
        step: that the count begins at, and `seconds` of the training until then.
    """

    def __init__(self, step: int, seconds: float) -> None:
        self._points = deque([(step, seconds)])

    def steps_a_second(self, step: int, seconds: float) -> float:
        """Add where the training is, and give the mean since the point half a minute before."""
        self._points.append((step, seconds))
        while self._points[1][1] <= seconds - PERIOD:
            self._points.popleft()
        first, begun = self._points[0]
        return (step - first) / max(seconds - begun, 1e-9)


def so_far(step: int, of: int, n_gaussians: int, rate: float, latest: str) -> str:
    """Tell how far a training is.

    Args:
        rate: steps a second.
        latest: what was measured last, in words that begin with a comma, or nothing.
    """
    line = f"step {step:,} of {of:,}, {n_gaussians:,} Gaussians{latest}"
    if step == of:
        return f"{line}, measuring and writing"
    return f"{line}, {rate:.1f} steps a second, {duration((of - step) / max(rate, 1e-9))} left"


# s, before which the first ones say little of the rest
_SURE_AFTER: Final = 1.0
Report = Callable[[str, int, int], None]


@contextmanager
def bars(show: bool = True) -> Iterator[Report]:
    """Show one bar a stage on standard error, or lines where that is no terminal; yields the function to report to."""
    # not at the top: the help of a command does without it
    from tqdm import tqdm

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
