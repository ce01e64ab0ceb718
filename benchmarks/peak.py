"""What the machine can do at most: vector operations a second, and bytes read and written a second."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from cuda_ext.compiler import find_compiler, no_compiler

LANES = 16  # floats of an operation as it is counted, whatever this processor's vectors are
SOURCE = Path(__file__).resolve().with_suffix(".cpp")
ROUNDS, REPEATS = 2_000_000, 9
# bytes of the arrays that a bandwidth is measured on, and how many are moved at least: starting threads is little of it
SMALLEST, LARGEST, MOVED = 1 << 17, 1 << 28, 1 << 28


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
    return (
        threads
        * 8
        * size
        * rounds
        / _best([lambda share=share: library.passes(share.ctypes.data, size, rounds) for share in shares])
    )


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
