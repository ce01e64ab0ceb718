"""How long a run has taken: by the clock, and of the processor, over all the pieces that it was trained in."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

__all__ = ["Stopwatch", "Times"]


class Stopwatch:
    """Measures a piece of work from when it is made."""

    def __init__(self) -> None:
        self._clock, self._cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Give the seconds since: by the clock, and of the processor over all threads of this process."""
        return time.perf_counter() - self._clock, time.process_time() - self._cpu


@dataclass
class Times:
    """The times of a run, s.

    Attributes:
        loading: of reading the capture and of compiling, by the clock.
        sfm: of searching for the capture's cameras before that, by the clock; 0 where they were there.
        train: of steps and density control, by the clock.
        cpu: of the same on the processor; None where a part of the run did not count it.
    """

    loading: float = 0.0
    sfm: float = 0.0
    train: float = 0.0
    cpu: float | None = 0.0
    _started: float = 0.0

    def start(self) -> None:
        """Begin to count the total."""
        self._started = time.perf_counter()

    @property
    def total(self) -> float:
        """All since the start, by the clock, and what the run took before it was stopped."""
        return time.perf_counter() - self._started

    @contextmanager
    def is_loading(self) -> Iterator[None]:
        """Count what is done meanwhile as loading."""
        start = time.perf_counter()
        yield
        self.loading += time.perf_counter() - start

    def add(self, train: float, cpu: float) -> None:
        """Count some steps."""
        self.train += train
        if self.cpu is not None:
            self.cpu += cpu

    def facts(self, on_cpu: bool) -> dict[str, float]:
        """Give what belongs beside `seconds` and `seconds_total`: processor time is that of a training on a CPU."""
        counted = {"seconds_cpu": self.cpu} if on_cpu and self.cpu is not None else {}
        searched = {"seconds_sfm": self.sfm} if self.sfm else {}
        return {"seconds_loading": self.loading, **searched, **counted}

    def state_dict(self) -> dict[str, float | None]:
        """Give what a checkpoint keeps."""
        return {"train": self.train, "total": self.total, "cpu": self.cpu}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a checkpoint that `pop_fast.train.checkpoint_checks` has let pass."""
        self.train, self.cpu = state["train"], state["cpu"]
        self._started -= state["total"]
