"""What there is to say of the machine, for statistics and for `pop doctor`, without torch."""

from __future__ import annotations

import platform
from pathlib import Path


def machine_name() -> str:
    """Return the processor's name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


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
