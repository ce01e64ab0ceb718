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

from pop_fast.io.atomic import write_file
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
    """Write results, so that a file is whole or not there."""
    write_file(path, text_of(result))


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


def lines_run(gcov: str, folder: Path, counted: Sequence[str], check: bool = False) -> dict[tuple[Path, int], bool]:
    """Return whether each line ran that was compiled to be counted, by file and number.

    Args:
        gcov: the program.
        folder: in which the compiler worked.
        counted: names of the files of counts in there.
        check: raise where the program fails; without, nothing ran then.
    """
    asked = [gcov, "--json-format", "--stdout", *counted]
    ran: dict[tuple[Path, int], bool] = {}
    for text in subprocess.run(asked, capture_output=True, text=True, check=check, cwd=folder).stdout.splitlines():
        for file in json.loads(text)["files"]:
            path = Path(folder, file["file"]).resolve()
            for line in file["lines"]:
                # a line of a template is counted once for each type that it is made for
                at = path, line["line_number"]
                ran[at] = ran.get(at, False) or line["count"] > 0
    return ran


def with_table(text: str, name: str, table: str) -> str:
    """Put a table between its marks, `<!-- NAME -->` and `<!-- end of NAME -->`."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    head, rest = text.split(begin)
    return head + begin + table + "\n" + end + rest.split(end)[1]
