"""A sign of life while long work runs: a bar's clock in a terminal, a line every half minute in a log or a notebook."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Final

__all__ = ["PERIOD", "Heartbeat", "duration", "so_far"]

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
        """Set what the next line tells."""
        self._text = text

    def __enter__(self) -> Heartbeat:
        self._started = time.monotonic()
        if self._does is not None:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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


def so_far(step: int, of: int, n_gaussians: int, seconds: float, latest: str) -> str:
    """Tell how far a training is.

    Args:
        step: steps taken, at least 1.
        of: steps in all.
        n_gaussians: how many there are.
        seconds: that the steps took.
        latest: what was measured last, in words that begin with a comma, or nothing.
    """
    line = f"step {step:,} of {of:,}, {n_gaussians:,} Gaussians{latest}"
    if step == of:
        return f"{line}, measuring and writing"
    return f"{line}, {step / max(seconds, 1e-9):.1f} steps a second, {duration(seconds * (of - step) / step)} left"
