"""What a native step would take on a machine of more cores than this one: a simulation from the work of its parts.

A step is a row of works, each cut into parts that no thread changes (`pop_fast/compiled/pool.h`). One
thread takes steps of which every part is timed, cut as for the threads of the machine in question. Then, work by work:

    time of a work = what one thread has for itself before it + HANDOVER
                     + the larger of: when the last thread is done, each taking the next part that nobody has taken;
                                      the work's bytes (`parts.works`), at the bandwidth of that machine

What is assumed: a core is as fast as this one, also where all are at work, and caches are shared as here. So the times
are bounds from below, and what they are good for is what bounds a step there.
"""

from __future__ import annotations

import heapq
import itertools
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from cases import Case, capture_of
from parts import works
from steps import run_of_case

from pop_fast.train.environment import reproducible
from pop_fast.train.schedule import phase_at

# cores, and the bytes a second that such a machine moves: two channels of DDR5-5600, a desktop's; eight of DDR5-4800, a
# server's. None where the memory is not looked at: one core does not fill it.
MACHINES: Final = {1: None, 2: None, 16: 70e9, 64: 250e9}
# seconds from a work's last part to the first of the next: a thread looks for more for some microseconds, see `pool.h`
HANDOVER: Final = 5e-6
# of which part of a step each work is
PART_OF: Final = ("project", *["list"] * 6, "blend", "loss", "image_gradient", "transpose", "update", "update")
TRACED, WARM = 12, 8  # steps whose least times count, and those before


@dataclass(frozen=True)
class Timed:
    """A work of a step: seconds that one thread has for itself before it, and those of each part."""

    alone: float
    parts: Sequence[float]


def steps_of(pairs: Sequence[Sequence[float]]) -> Iterator[list[Timed]]:
    """Yield the works of each step of a trace of `NativeTrainer.traced`."""
    works_of, work = [], []
    for kind, seconds in pairs:
        if kind == 0.0 and work:
            works_of.append(Timed(work[0], work[1:]))
            work = []
        work.append(seconds)
    # what is left is the time after the last step
    for begin in range(0, len(works_of), len(PART_OF)):
        step = works_of[begin : begin + len(PART_OF)]
        if len(step) == len(PART_OF):
            yield step


def last_one_done(parts: Sequence[float], threads: int) -> float:
    """Return when all parts are done by threads that each take the next one that nobody has taken."""
    free = [0.0] * threads
    for seconds in parts:
        heapq.heapreplace(free, free[0] + seconds)
    return max(free)


def simulated(step: Sequence[Timed], threads: int, moved: Mapping[str, float], rate: float | None) -> dict[str, float]:
    """Return the milliseconds of a step, and of these what is more than a thread's even share, by its reason.

    Args:
        step: its works.
        threads: that take part.
        moved: bytes of each part of a step.
        rate: bytes a second of the machine, None where its memory is not looked at.
    """
    alone = sum(work.alone for work in step)
    handed = HANDOVER * len(step) if threads > 1 else 0.0
    even = sum(sum(work.parts) for work in step) / threads
    uneven = memory = 0.0
    for name, of_part in itertools.groupby(zip(PART_OF, step, strict=True), key=lambda pair: pair[0]):
        group = [work for _, work in of_part]
        done = sum(last_one_done(work.parts, threads) for work in group)
        uneven += done - sum(sum(work.parts) for work in group) / threads
        memory += 0.0 if rate is None else max(moved[name] / rate - done, 0.0)
    shares = {"even share": even, "one thread alone": alone, "uneven parts": uneven, "handing over": handed}
    shares["memory"] = memory
    return {name: 1e3 * seconds for name, seconds in shares.items()}


def traced(case: Case, threads: int) -> tuple[list[list[Timed]], dict[str, float]]:
    """Take steps of a case whose works are cut for so many threads; return what their parts took, and moved bytes."""
    with tempfile.TemporaryDirectory() as folder, reproducible(threads):
        training = run_of_case(case, folder, "native")
        training.take_steps(1)
        trainer, first = training.stepper.fused, training.step
        phase = phase_at(training.config, training.strategy, first)
        for step in range(first, first + WARM + len(capture_of(case).views)):
            trainer.run(step + 1, phase)
        pairs = trainer.traced(trainer.step + TRACED, phase)
        row = {"num_gaussians": case.n, "width": case.width, "height": case.height, "degree": phase.sh_degree}
        moved = {name: work.bytes for name, work in works({**row, "counts": trainer.counts()}).items()}
    return list(steps_of(pairs.tolist())), moved


def simulate(case: Case) -> dict[str, Any]:
    """Simulate a case on every machine: the least of the traced steps, since others share this one."""
    found = {}
    for threads, rate in MACHINES.items():
        steps, moved = traced(case, threads)
        told = [simulated(step, threads, moved, rate) for step in steps]
        found[str(threads)] = min(told, key=lambda shares: sum(shares.values()))
    return {"name": case.name, "num_gaussians": case.n, "width": case.width, "height": case.height, "machines": found}
