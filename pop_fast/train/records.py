"""The records of metrics.jsonl: what of a step's measurements is written, under which names, and how long it took."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from pop_fast.density.protocol import DensificationStep
from pop_fast.train.config import TrainConfig
from pop_fast.train.steps import Phase, StepStats


@dataclass(frozen=True)
class Segment:
    """Steps of one phase, taken one after the other, and the densification step after the last of them.

    Attributes:
        first: number of the first step, from 0.
        phase: what they did.
        views: name of the photograph of each step.
        stats: of each step.
        densification: what density control did after the last, None where nothing was due.
        before: Gaussians that were trained.
        after: Gaussians after that.
        seconds: that all of it took, by the clock.
        seconds_cpu: of processor time, over all threads.
    """

    first: int
    phase: Phase
    views: list[str]
    stats: list[StepStats]
    densification: DensificationStep | None
    before: int
    after: int
    seconds: float
    seconds_cpu: float


def record_of(
    segment: Segment, step: int, config: TrainConfig, lr_means: float, seconds_before: float
) -> dict[str, Any] | None:
    """Make the record of a step, or None where none is due: every `log_every` steps there is one, and at every change.

    What the engine has not measured is left out.

    Args:
        segment: that the step belongs to.
        step: its number.
        config: step numbers as they are run.
        lr_means: learning rate of the means at that step, world units.
        seconds_before: of training, before the segment.
    """
    place = step - segment.first
    stats, last = segment.stats[place], place + 1 == len(segment.stats)
    densification = segment.densification if last else None
    if step % config.log_every != 0 and densification is None:
        return None
    halved = 0.5 if segment.phase.objective.d_ssim_halved else 1.0
    measured = {
        segment.phase.objective.pixelwise: stats.pixelwise,
        "d_ssim": halved * (1.0 - stats.ssim),
        "psnr": -10.0 * math.log10(stats.square) if stats.square != 0.0 else math.inf,
        "n_blended": stats.n_blended,
        "n_traversed": stats.n_traversed,
    }
    return {
        "step": step,
        "view": segment.views[place],
        "loss": stats.objective + stats.pop,
        **{name: value for name, value in measured.items() if not math.isnan(value)},
        **({"pop": stats.pop} if segment.phase.pop or stats.pop != 0.0 else {}),
        "num_gaussians": segment.before if densification is None else segment.after,
        "sh_degree": segment.phase.sh_degree,
        "lr_means": lr_means,
        "it_per_s": len(segment.stats) / segment.seconds,
        "seconds": seconds_before + segment.seconds * (place + 1) / len(segment.stats),
        **({} if densification is None else densification.record()),
    }


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
        """Give what goes with `seconds` and `seconds_total`: processor time is that of a training on a CPU."""
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
