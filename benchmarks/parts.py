"""What each part of the native step has to do at least, and the time that this machine needs for it.

A floor is the larger of two times, with all threads at work all the time: of the part's vector operations, as if each
were a fused multiply-add, of which the processor was seen to do so many a second (`peak.cpp`); and of the bytes that it
must read and write, at the rate of a pass over an array of that size.

What is counted (`NativeTrainer.counts`, exact): Gaussians, list entries, chunks of sixteen entries, strips of sixteen
pixels that an entry is blended into. What a strip or a chunk costs is read off `pop_fast/compiled`: arithmetic,
comparisons and selections on vectors of sixteen floats; moves, broadcasts and loads are left out. What a Gaussian costs
is the arithmetic in the machine code of the CUDA kernels (`results/sass.json`), whose functions the step calls.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from record import read_json

from cuda_ext.toolkit import find_compiler, no_compiler

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
