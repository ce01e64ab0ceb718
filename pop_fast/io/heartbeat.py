"""A line of progress every half minute where nobody sees a bar: in log files, under Slurm and nohup, in notebooks."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType
from typing import Final

__all__ = ["PERIOD", "Heartbeat", "duration", "so_far"]

# seconds between two lines
PERIOD: Final = 30.0


class Heartbeat:
    """Tell on standard error what is being done, while the block runs, as long as that is no terminal.

    A thread of its own tells it, so that a line also comes from within one long computation.

    Args:
        show: False tells nothing.
        period: seconds between two lines; None takes `PERIOD`.

    Example:
        with Heartbeat() as beat:
            for done, photograph in enumerate(photographs):
                beat.say(f"reading photographs: {done} of {len(photographs)}")
    """

    def __init__(self, show: bool = True, period: float | None = None) -> None:
        self._period = PERIOD if period is None else period
        # pythonw and some notebooks have no such stream
        self._shown = show and sys.stderr is not None and not sys.stderr.isatty()
        self._text = ""
        self._started = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._tell, name="heartbeat", daemon=True)

    def say(self, text: str) -> None:
        """Set what the next line tells."""
        self._text = text

    def __enter__(self) -> Heartbeat:
        self._started = time.monotonic()
        if self._shown:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        if self._shown:
            self._thread.join()

    def _tell(self) -> None:
        while not self._over.wait(self._period):
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
    return f"{line}, {step / max(seconds, 1e-9):.1f} steps a second, {duration(seconds * (of - step) / step)} left"
