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
