"""What is noted with every result, and how results are written."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from pop_fast.machine import machine_name


def machine() -> dict[str, Any]:
    """Describe what times were taken on."""
    return {
        "cpu": machine_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load_before": os.getloadavg()[0],
        "torch": torch.__version__,
        "capability": torch.backends.cpu.get_cpu_capability(),
        "python": platform.python_version(),
        "commit": commit(Path(__file__).resolve().parent),
    }


def commit(checkout: Path) -> str:
    """Return the commit that a checkout is at, empty where git does not know it."""
    asked = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()


def read_json(path: Path) -> dict[str, Any]:
    """Read earlier results; empty where there are none."""
    return dict(json.loads(path.read_text(encoding="utf-8"))) if path.exists() else {}


def write_json(path: Path, result: dict[str, Any]) -> None:
    """Write results under a temporary name and rename, so that a file is whole or not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_suffix(".part")
    beside.write_text(text_of(result), encoding="utf-8")
    os.replace(beside, path)


def text_of(result: dict[str, Any]) -> str:
    """Write results as JSON with one line for each entry, so that a difference shows which entry has changed."""
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(value)}" for name, value in result.items())
    return f"{{\n{lines}\n}}\n"


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]], rule: Sequence[str] = ()) -> str:
    """Make a Markdown table; `rule` says how columns are aligned."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule or ["---"] * len(head), *rows))


def peak_bytes(field: str = "VmHWM") -> int:
    """Return how much memory this process has had at most, or a field of /proc/self/status in its place."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:"))


def with_table(text: str, name: str, table: str) -> str:
    """Put a table between its marks, `<!-- NAME -->` and `<!-- end of NAME -->`."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    head, rest = text.split(begin)
    return head + begin + table + "\n" + end + rest.split(end)[1]
