"""What `pop train` says before its first step against what came: minutes, Gaussians and memory.

    python benchmarks/estimates.py fox bear_512 --minutes 1 --json benchmarks/results/estimates.json
    python benchmarks/estimates.py --json benchmarks/results/estimates.json

Each capture is trained by one thread, without any other option. Other programs disturb a clock, so that the run's own
clock, by which it foretells, shows its processor time here, and that is compared: without reading the photographs, and
without the search for cameras, which the line leaves out too, but with the program's start. A row
that the JSON already holds is replaced, others are kept. Without captures the rows are printed as a table.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final

from benchmarks.record import machine, markdown, read_json, write_json
from pop_fast.children import module_command
from pop_fast.cli import train
from pop_fast.train import automatic
from pop_fast.train.results import ResultFolder

_LINE: Final = re.compile(
    r"chosen for this \w+: (?P<width>\d+)x(?P<height>\d+) px.*?, (?P<steps>[\d,]+) steps, "
    r"about (?P<gaussians>[\d,]+) Gaussians, (?P<time>[^,]+), (?P<memory>[\d.]+) GB"
)
BY_PROCESSOR: Final = "by-processor-time"
_UNITS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0}


def seconds_of(text: str) -> float:
    """Read a time as `duration` writes it."""
    return sum(float(number) * _UNITS[unit] for number, unit in re.findall(r"(\d+) (s|min|h)", text))


def foretold(text: str) -> dict[str, Any]:
    """Read the line before the first step.

    Raises:
        ValueError: the run said none.
    """
    found = _LINE.search(text)
    if found is None:
        raise ValueError(f"no line says what was chosen:\n{text}")
    size = f"{found['width']}x{found['height']}"
    steps, gaussians = (int(found[name].replace(",", "")) for name in ("steps", "gaussians"))
    said = {"gaussians": gaussians, "seconds": seconds_of(found["time"]), "memory": float(found["memory"])}
    return {"size": size, "steps": steps, "foretold": said}


def measured(capture: Path, minutes: float) -> dict[str, Any]:
    """Train as a user would, and compare."""
    with TemporaryDirectory() as folder:
        words = [str(capture), "--minutes", f"{minutes:g}", "--out", f"{folder}/run", "--threads", "1"]
        with open(f"{folder}/said", "w+", encoding="utf-8") as said:
            child = subprocess.Popen(module_command("benchmarks.estimates", BY_PROCESSOR, *words), stdout=said)
            _, status, used = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
            if child.returncode:
                raise subprocess.CalledProcessError(child.returncode, words)
            said.seek(0)
            row = foretold(said.read())
        stats = ResultFolder(Path(folder) / "run").read_stats("val", row["steps"] - 1) or {}
    taken = used.ru_utime + used.ru_stime - stats["seconds_loading"] - stats.get("seconds_sfm", 0.0)
    came = {"gaussians": stats["num_GS"], "seconds": round(taken, 1), "memory": round(used.ru_maxrss * 1024 / 1e9, 2)}
    return {**row, "minutes": minutes, "came": came}


def train_by_processor_time(words: list[str]) -> int:
    """Run `pop train` with a clock that shows the processor time of its process where it foretells and reads."""
    clock = SimpleNamespace(perf_counter=time.process_time)
    for module in (automatic, train):
        vars(module)["time"] = clock
    return train.run(words)


def table_of(known: Mapping[str, Any]) -> str:
    """Lay the rows of a JSON file out: what was foretold, what came, and the ratio of the times."""
    rows = []
    for name, row in known.items():
        if name == "machine":
            continue
        said, came = row["foretold"], row["came"]
        times = [f"{said['seconds']:.0f} s, {came['seconds']:.0f} s", f"{came['seconds'] / said['seconds']:.2f}"]
        counts = [f"{said['gaussians']:,}, {came['gaussians']:,}", f"{said['memory']:.1f}, {came['memory']:.1f}"]
        rows.append([name, f"{row['size']}, {row['steps']:,}", *times, *counts])
    head = ["capture, `--minutes`", "px, steps", "time: predicted, taken", "ratio", "Gaussians", "GB of memory"]
    return markdown(head, rows, ["---", "---", "---", "---:", "---", "---"])


def main(words: list[str] | None = None) -> int:
    """Measure, a row for each capture."""
    given = sys.argv[1:] if words is None else words
    if given[:1] == [BY_PROCESSOR]:
        return train_by_processor_time(given[1:])
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("captures", type=Path, nargs="*", help="without any, the rows of --json are laid out")
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--json", type=Path, help="keep the rows here")
    args = parser.parse_args(given)
    known = {} if args.json is None else read_json(args.json)
    for capture in args.captures:
        name = f"{capture.name}, {args.minutes:g}"
        row = {"machine": machine(), **measured(capture, args.minutes)}
        print(table_of({name: row}).splitlines()[-1], flush=True)
        if args.json is not None:
            # another call may have written meanwhile
            write_json(args.json, {"machine": row["machine"], **read_json(args.json), name: row})
    if not args.captures:
        print(table_of(known))
    return 0


if __name__ == "__main__":
    sys.exit(main())
