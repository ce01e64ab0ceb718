"""What a run's bits depend on apart from its settings: threads, denormal numbers, versions, the machine."""

from __future__ import annotations

import contextlib
import ctypes
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from pop_fast.machine import machine_name

_OMP_PAUSE_SOFT = 1
_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of glibc's mallopt
_LARGEST_INT = 2**31 - 1


@contextlib.contextmanager
def reproducible(threads: int = 0) -> Iterator[None]:
    """Run a block with a fixed number of threads, deterministic operations and no denormal numbers; then put all back.

    Denormals are flushed to zero because the moments of Gaussians that no view sees decay into them, and stay there,
    and arithmetic on them is slow. The flag belongs to a thread and is inherited when a thread is born, so torch's pool
    of threads is dismissed after setting it; the next operation makes a new one.
    """
    before = torch.get_num_threads()
    # `use_deterministic_algorithms` says the same to torch's compiler too, and imports it for that: 0.6 s
    deterministic = torch.get_deterministic_debug_mode()
    mode: Any = torch.utils.deterministic
    filling = mode.fill_uninitialized_memory
    torch.set_num_threads(threads if threads > 0 else before)
    # would write NaN into every empty tensor first: it guards against reading them, and costs a pass over the memory
    mode.fill_uninitialized_memory = False
    torch.set_deterministic_debug_mode("error")
    _flush_denormals(True)
    try:
        yield
    finally:
        _flush_denormals(False)
        torch.set_deterministic_debug_mode(deterministic)
        mode.fill_uninitialized_memory = filling
        torch.set_num_threads(before)


def keep_freed_memory() -> bool:
    """Let the C library keep memory that was freed, for this process and from now on.

    By default glibc hands every large block back to the system and asks for it anew; the system then fills each page
    with zeros when it is first touched. A training step fills and frees a few hundred MB, and this is a tenth to a
    sixth of its time (benchmarks/NOTES.md).

    Returns:
        Whether the C library takes such settings; others than glibc do not, and nothing changes.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, _LARGEST_INT))


def _flush_denormals(on: bool) -> None:
    torch.set_flush_denormal(on)
    for library in _openmp_libraries():
        pause = getattr(library, "omp_pause_resource_all", None)
        if pause is not None:
            pause(_OMP_PAUSE_SOFT)
    if on and not _threads_flush_denormals():
        # all threads or none: half of a tensor rounded one way would depend on how the pool was born
        torch.set_flush_denormal(False)


def _openmp_libraries() -> list[ctypes.CDLL]:
    """Return the OpenMP runtimes that torch brought into this process (Linux; elsewhere none are found)."""
    maps = Path("/proc/self/maps")
    if not maps.exists():
        return []
    lines = [line.split(maxsplit=5) for line in maps.read_text().splitlines()]
    files = {fields[5] for fields in lines if len(fields) == 6 and "/torch/lib/" in fields[5] and "omp" in fields[5]}
    return [ctypes.CDLL(file) for file in sorted(files)]


def _threads_flush_denormals() -> bool:
    # large enough that torch shares it out over all threads
    smallest = torch.full((torch.get_num_threads() * 65_536,), torch.finfo(torch.float32).tiny)
    return bool((smallest * 0.5 == 0.0).all())


def peak_memory_bytes() -> int:
    """Return the most memory that this process has held resident; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def run_facts(backend: str, train_seconds: float, total_seconds: float) -> dict[str, Any]:
    """Return what else goes with a result: time, memory, machine. `mem` is in GiB, as gsplat's."""
    peak = peak_memory_bytes()
    return {
        "seconds": train_seconds,
        "seconds_total": total_seconds,
        "memory_bytes": peak,
        "mem": peak / 2**30,
        "machine": machine_name(),
        "threads": torch.get_num_threads(),
        "backend": backend,
        "versions": versions(),
    }


def versions() -> dict[str, str]:
    """Return the versions of what a result depends on."""
    found = {"python": platform.python_version(), "torch": str(torch.__version__)}
    for name in ("numpy", "opencv-contrib-python-headless", "pop-splatting"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
