"""Time the CPU path: first the correctness gate against the oracle, then the numbers, written as one JSON file.

    python benchmarks/run.py                          all of it, results to benchmarks/results/cpu.json
    python benchmarks/run.py --only steps             one part; the others of the file stay: see PARTS
    python benchmarks/run.py --capture DIR --factor 4 also training steps on a real capture, and `pop train` on it

Every time is the median of `--repeats` runs in one process after warm-up, in which the backends take turns, so that the
ratios hold on a noisy machine; threads, machine and load are noted. No speed is reported on a red gate.
`python docs/tables.py --write` and `python benchmarks/results_table.py --write` put the results into
docs/speed.md and NOTES.md.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))
from cases import RASTER_CASES, STEP_CASES, capture_of
from parts import LARGEST, bytes_per_s, floors, simulate, vector_ops_per_s
from processes import measure, time_beside, time_startup
from record import commit, machine, read_json, write_json
from steps import (
    backends,
    blend_of,
    capture_runs,
    engines,
    first_view,
    gate,
    run_of,
    run_of_case,
    time_capture,
    time_case,
    time_raster,
)

from pop_fast.train.environment import keep_freed_memory, reproducible

# `ab_benchmark` finds here what it times of each checkout
__all__ = [
    "RASTER_CASES",
    "blend_of",
    "capture_of",
    "commit",
    "first_view",
    "keep_freed_memory",
    "machine",
    "reproducible",
    "run_of",
    "write_json",
]

RESULTS = Path(__file__).resolve().parent / "results" / "cpu.json"


def steps(given: argparse.Namespace) -> Any:
    """Time training steps of every engine, and say where those of the native step go."""
    rows = [time_case(case, given.repeats) for case in STEP_CASES if case.name in given.cases]
    for degree in (0, 3) if given.capture else ():
        rows.append(time_capture(given.capture, given.factor, degree, given.repeats))
    for row in rows:
        if "parts_ms" in row:
            row["parts"] = floors(row)
    threads = torch.get_num_threads()
    rates = {"vector_ops_per_s": vector_ops_per_s(threads), "bytes_per_s": bytes_per_s(LARGEST, threads)}
    return {"peak": {"threads": threads, **rates}, "cases": rows}


def memory(_: argparse.Namespace) -> Any:
    """Measure the memory of a render and of training steps."""
    return [*(measure("render", name) for name in backends()), *(measure("step", name) for name in engines())]


def busy(given: argparse.Namespace) -> Any:
    """Time training steps while other processes take all they get."""
    case = RASTER_CASES[0]
    rows = [time_beside(case.name, lambda folder, engine: run_of_case(case, folder, engine), given.repeats)]
    if given.capture:
        capture, make = capture_runs(given.capture, given.factor, 0)
        rows.append(time_beside(capture.name, make, given.repeats))
    return rows


PARTS: dict[str, Callable[[argparse.Namespace], Any]] = {
    # renders, and the blend alone
    "raster": lambda given: [time_raster(case, given.repeats) for case in RASTER_CASES],
    "steps": steps,
    # steps on machines of more cores, simulated
    "cores": lambda given: [simulate(case) for case in STEP_CASES if case.name in given.cases],
    "memory": memory,
    # `pop` from its command on
    "first-step": lambda given: time_startup(given.capture, given.factor),
    "busy": busy,
}


def main() -> None:
    """Run what is asked for and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--only", choices=PARTS, default=None)
    parser.add_argument("--cases", nargs="+", default=[case.name for case in STEP_CASES], help="of steps")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--capture", default=None)
    parser.add_argument("--factor", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    keep_freed_memory()  # as `pop train` does
    kept = read_json(given.out) if given.only else {}
    result: dict[str, Any] = {**kept, "machine": machine(), "gate": gate(), "measured": kept.get("measured", {})}
    for name, measured in PARTS.items():
        if given.only in (None, name):
            torch.set_num_threads(given.threads)
            result["measured"][name] = machine()
            result[name] = measured(given)
            write_json(given.out, result)
    print(json.dumps({name: result[name] for name in result if given.only in (None, name)}, indent=2))


if __name__ == "__main__":
    main()
