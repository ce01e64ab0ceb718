"""What there is to say of the machine, for statistics and for `pop doctor`, without torch."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path


def machine_name() -> str:
    """Return the processor's name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def memory_bytes() -> tuple[int, int]:
    """Give the machine's memory and what is free of it, bytes; (0, 0) where the system does not tell."""
    try:
        with open("/proc/meminfo", encoding="utf-8") as file:
            sizes = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in file}
        return sizes["MemTotal"], sizes["MemAvailable"]
    except (OSError, KeyError, ValueError, IndexError):
        pass
    if sys.platform != "win32" and "SC_PHYS_PAGES" in os.sysconf_names:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        return total, total
    return 0, 0


def free_bytes() -> int | None:
    """Give the memory that this process can still take, bytes: the system's, and within its limits; None if unknown."""
    available = memory_bytes()[1]
    found = [available] if available else []
    found += [left for left in (_left_of_container(), _left_of_address_space()) if left is not None]
    return min(found, default=None)


def _left_of_container() -> int | None:
    """Give what the limit of the container (cgroup v2) leaves; what only caches files is given back when needed."""
    folder = Path("/sys/fs/cgroup")
    try:
        limit, used = (int((folder / f"memory.{name}").read_text()) for name in ("max", "current"))
        lines = (folder / "memory.stat").read_text().splitlines()
        cached = next((int(line.split()[1]) for line in lines if line.startswith("inactive_file ")), 0)
    # "max" is no number: then there is no limit
    except (OSError, ValueError, IndexError):
        return None
    return max(limit - used + cached, 0)


def _left_of_address_space() -> int | None:
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        return max(limit - pages * resource.getpagesize(), 0)
    except (ImportError, OSError, ValueError, IndexError):
        return None


def processor_kind() -> str | None:
    """Say which kind of processor this is: family, model and stepping, and the widest vectors that it computes with.

    Two processors of one name can differ in these, and with them the last bits of what a library computes. None where
    the system does not tell them as Linux does on x86-64.
    """
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().split("\n\n")[0].splitlines() if cpuinfo.exists() else []
    known = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    if "vendor_id" not in known:
        return None
    flags = known.get("flags", "").split()
    vectors = next((name for name in ("avx512f", "avx2", "avx") if name in flags), "sse")
    return " ".join([*(known.get(key, "?") for key in ("vendor_id", "cpu family", "model", "stepping")), vectors])
