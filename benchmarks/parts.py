"""What each part of the native step has to do at least, and the time that machines need for it: this and larger ones.

A floor is the larger of two times, with all threads at work all the time: of the part's vector operations, as if each
were a fused multiply-add, of which the processor was seen to do so many a second (`peak.cpp`); and of the bytes that it
must read and write, at the rate of a pass over an array of that size.

What is counted (`NativeTrainer.counts`, exact): Gaussians, list entries, chunks of sixteen entries, strips of sixteen
pixels that an entry is blended into. What a strip or a chunk costs is read off `pop_fast/compiled`: arithmetic,
comparisons and selections on vectors of sixteen floats; moves, broadcasts and loads are left out. What a Gaussian costs
is the arithmetic in the machine code of the CUDA kernels (`results/sass.json`), whose functions the step calls.

A machine of more cores is simulated. A step is a row of works, each cut into parts that no thread changes
(`pop_fast/compiled/threads.h`). One thread takes steps of which every part is timed, cut as for the threads of the
machine in question. Then, work by work:

    time of a work = what one thread has for itself before it + HANDOVER
                     + the larger of: when the last thread is done, each taking the next part that nobody has taken;
                                      the work's bytes (`works`), at the bandwidth of that machine

What is assumed: a core is as fast as this one, also where all are at work, and caches are shared as here. So the times
are bounds from below, and what they are good for is what bounds a step there.
"""

from __future__ import annotations

import ctypes
import heapq
import itertools
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from cases import Case, capture_of
from record import read_json
from steps import run_of_case

from cuda_ext.toolkit import find_compiler, no_compiler
from pop_fast.train.environment import reproducible
from pop_fast.train.schedule import phase_at

SASS: Final = Path(__file__).resolve().parent / "results" / "sass.json"
TILE: Final = 16
# of a strip: f3 x^2 + linear x + constant; what is left of e after its integer, six terms, the integer, the scaling;
# ceiling, floor and stop with their selections, T - T alpha, T alpha
EXPONENT, POWER, TAKE = 2, 9, 8
# whether T went down, sum of weights, three colours; comparison, two selections and the entry's number of dominance
BLENDED, DOMINANCE = 5, 4
# q from v and what is behind (4), three colours, what is behind, dx, G, the ceiling, G dx, six moments
ENTRY_SUMS = 18
# of a chunk: its coefficients in double, two vectors each, and rounded; on each row, its parabolas (3) and their maxima
GATHERED, PARABOLAS, MAXIMA = 42, 3 * TILE, 16 * TILE
# nine sums of sixteen entries by a tree: 15 additions and 30 shuffles each
COLUMNS: Final = 9
TREE = 45 * COLUMNS
# of a window or a pixel and channel: eleven taps down and across of three maps; the quotient and its derivatives; L2
TAPS, QUOTIENT, SLOPE, DIFFERENCE = 66, 32, 7, 8
ADAM = 9  # of a number
# bytes: of a Gaussian's splat and of what else is kept of it, of an entry's splat and slot, of a chunk's T and marks
SPLAT, SEEN, LISTED, CHUNK = 64, 64, 12, TILE * TILE * 4 + TILE * 2
SHORT: Final = 14  # numbers of a Gaussian without the bands beyond the first
# a part in less than this of its floor is not possible: clocks differ by less between two measurements
POSSIBLE: Final = 0.8
LANES = 16  # floats of an operation as it is counted, whatever this processor's vectors are
SOURCE = Path(__file__).resolve().with_name("peak.cpp")
ROUNDS, REPEATS = 2_000_000, 9
# bytes of the arrays that a bandwidth is measured on, and how many are moved at least: starting threads is little of it
SMALLEST, LARGEST, MOVED = 1 << 17, 1 << 28, 1 << 28
# cores, and the bytes a second that such a machine moves: two channels of DDR5-5600, a desktop's; eight of DDR5-4800, a
# server's. None where the memory is not looked at: one core does not fill it.
MACHINES: Final = {1: None, 2: None, 16: 70e9, 64: 250e9}
# seconds from a work's last part to the first of the next: a thread looks for more for some microseconds (`threads.h`)
HANDOVER: Final = 5e-6
# of which part of a step each work is
PART_OF: Final = ("project", *["list"] * 6, "blend", "loss", "image_gradient", "transpose", "update", "update")
TRACED, WARM = 12, 8  # steps whose least times count, and those before


@dataclass(frozen=True)
class Work:
    """What a part has to do: operations on vectors of sixteen floats, and bytes moved."""

    operations: float
    bytes: float


def works(row: Mapping[str, Any]) -> dict[str, Work]:
    """Return the work of each part.

    Args:
        row: one of `steps`: Gaussians, size, degree, counts.
    """
    n, degree, did = row["num_gaussians"], row["degree"], row["counts"]
    visible, chunks, entries, walked = did["visible"], did["chunks"], did["entries"], did["walked"]
    rest = 3 * ((degree + 1) ** 2 - 1)
    pixels = row["width"] * row["height"]
    channels = 3 * pixels  # numbers of a picture
    strip = EXPONENT + POWER + TAKE
    forward = did["marked"] * (strip + BLENDED + DOMINANCE) + chunks * (GATHERED + PARABOLAS + MAXIMA)
    back = did["reached"] * (strip + ENTRY_SUMS) + chunks * (GATHERED + PARABOLAS + TREE)
    lists = walked * (SPLAT + LISTED) + chunks * CHUNK
    numbers = SHORT + rest
    adam = n * numbers * 24  # three arrays, read and written
    return {
        "project": Work(
            visible * _of_gaussian(f"project_kernel<{degree}, false>") / LANES,
            4 * (n * SHORT + visible * rest) + n * SEEN + visible * SPLAT,
        ),
        "list": Work(0, visible * (8 * 9 + 2 * SEEN) + entries * LISTED),
        "blend": Work(forward + channels * DIFFERENCE / LANES, lists + 12 * channels),
        "loss": Work(channels * (TAPS + QUOTIENT) / LANES, 28 * channels),
        "image_gradient": Work(channels * (TAPS + SLOPE) / LANES, 24 * channels),
        "transpose": Work(back, lists + 4 * COLUMNS * entries + 4 * channels),
        "update": Work(
            (visible * _of_gaussian(f"update_kernel<{degree}>") + (n - visible) * numbers * ADAM) / LANES,
            adam + n * SEEN + 4 * COLUMNS * entries,
        ),
    }


def floors(row: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return each part's time, its floor, what bounds that, and their ratio.

    Raises:
        SystemExit: a part took far less than its floor, so that the peaks are not what this processor can do.
    """
    found = {}
    for part, work in works(row).items():
        by = {
            "operations": 1e3 * work.operations / vector_ops_per_s(row["threads"]),
            "bytes": 1e3 * work.bytes / bytes_per_s(work.bytes, row["threads"]),
        }
        bound = max(by, key=lambda name: by[name])
        ms = row["parts_ms"][part]
        found[part] = {"ms": ms, "floor_ms": by[bound], "bound": bound, "ratio": ms / by[bound]}
        if ms < POSSIBLE * by[bound]:
            raise SystemExit(
                f"{part} took {ms:.2f} ms, and {bound} alone need {by[bound]:.2f}: peak.cpp measures too little"
            )
    return found


def _of_gaussian(kernel: str) -> int:
    """Return the arithmetic instructions that a kernel spends on a Gaussian, in machine code for sm_90."""
    classes = next(k["by_class"] for k in read_json(SASS)["kernels"] if (k["kernel"], k["arch"]) == (kernel, "sm_90"))
    return int(classes["float"] + classes.get("special", 0))


@cache
def vector_ops_per_s(threads: int) -> float:
    """Return how many times sixteen multiply-adds so many threads do in a second: the best of a few runs."""
    library = _library()
    seconds = _best([lambda: library.multiply_adds(ROUNDS, 0.5, 1.0)] * threads)
    return threads * ROUNDS * int(library.a_round()) / LANES / seconds


def bytes_per_s(moved: float, threads: int) -> float:
    """Return the rate of threads that each read and write their share of an array, and move so many bytes in one pass.

    Arrays that fit a cache are read from there, as those of a training step are.
    """
    return _bandwidth(int(min(max(moved / 2, SMALLEST), LARGEST)).bit_length(), threads)


@cache
def _bandwidth(bits: int, threads: int) -> float:
    library, size = _library(), (1 << bits) // 4 // threads
    rounds = max(1, MOVED // (8 * size * threads))
    shares = [np.zeros(size, np.float32) for _ in range(threads)]
    seconds = _best([lambda share=share: library.passes(share.ctypes.data, size, rounds) for share in shares])
    return threads * 8 * size * rounds / seconds


@cache
def _library() -> ctypes.CDLL:
    compiler = find_compiler()
    if compiler is None:
        raise SystemExit(f"the peak of this processor cannot be measured: {no_compiler()}")
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "peak.so"
        flags = ("-O3", "-march=native", "-shared", "-fPIC", "-Wno-psabi")
        subprocess.run([*compiler, *flags, "-o", str(made), str(SOURCE)], check=True)
        library = ctypes.CDLL(str(made))
    library.multiply_adds.argtypes = (ctypes.c_int64, ctypes.c_float, ctypes.c_float)
    library.multiply_adds.restype = ctypes.c_float
    library.passes.argtypes, library.passes.restype = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64), None
    return library


def _best(calls: Sequence[Callable[[], object]]) -> float:
    """Return the least seconds of a few runs of calls side by side; through ctypes they do not hold Python's lock."""
    taken = []
    for _ in range(REPEATS):
        workers = [threading.Thread(target=call) for call in calls]
        start = time.perf_counter()
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        taken.append(time.perf_counter() - start)
    return min(taken)


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
