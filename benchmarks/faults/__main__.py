"""python -m benchmarks.faults [--minutes M] [--only PART] [--quick] [--seed N] [--save] [--out FILE]

Runs the parts below, prints what failed, and writes benchmarks/results/faults.json, of which docs/reliability.md has
the tables; a part that is run alone replaces its own results. With --minutes the fuzzer and the kill loop share that
time, or the one of them that runs has it; without, they stop after their least. --save keeps the files that broke a
reader among the regressions of benchmarks/faults/corpus. --quick tries a few places of those parts that have no test of
their own, as the tests do. Exit status 1 where anything failed.

    fuzz        mutated files to every reader, in children with limits of memory and time
    kills       SIGKILL at random moments of a run; continuing gives the same bits
    crashes     the process ends right before each rename, flush, new folder and removal
    writes      the system refuses each of them, or a write in its middle
    flips       single bits of a checkpoint
    sanitizers  the C++ kernels with AddressSanitizer and UndefinedBehaviorSanitizer
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import cv2
import torch

from . import fuzz, runs, sanitizers

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from record import machine, read_json, write_json

RESULTS = Path(__file__).resolve().parents[1] / "results" / "faults.json"
PARTS = ("fuzz", "kills", "crashes", "writes", "flips", "sanitizers")
QUICK = ("fuzz", "crashes", "writes", "sanitizers")


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--only", choices=PARTS, action="append")
    parser.add_argument("--reader", choices=tuple(fuzz.READERS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", action="store_true")
    parser.add_argument("--out", type=Path, default=RESULTS)
    args = parser.parse_args()
    # children that are forked must find no thread's locks taken
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    found = {part: result for part in args.only or (QUICK if args.quick else PARTS) for result in [_run(part, args)]}
    write_json(args.out, {**read_json(args.out), "machine": machine(), **found})
    failed = [line for part, result in found.items() for line in _failures(part, result)]
    print("\n".join(failed) or "nothing failed")
    return 1 if failed else 0


def _run(part: str, args: argparse.Namespace) -> dict[str, Any]:
    print(f"{part} ...", flush=True)
    if part == "fuzz":
        minutes = args.minutes if args.only == ["fuzz"] else args.minutes / 2.0
        return fuzz.fuzz(10 if args.quick else 1_000, minutes, args.seed, args.reader, args.save)
    if part == "sanitizers":
        return sanitizers.sanitized(compile_first=not args.quick)
    with runs.scene() as scene:
        if part == "kills":
            return runs.kill_loop(scene, 2 if args.quick else 50, args.minutes / 2.0, args.seed)
        if part == "flips":
            return runs.bit_flips(scene, 100 if args.quick else 5_000, args.seed)
        work = runs.crash_points if part == "crashes" else runs.failing_writes
        return work(scene, 2 if args.quick else None)


def _failures(part: str, result: dict[str, Any]) -> list[str]:
    if part in ("crashes", "writes"):
        return [f"{part}: {line}" for job in result.values() for line in job["failures"]]
    found = result["failures"]
    return [f"{part}: {line}: {found[line]}" if isinstance(found, dict) else f"{part}: {line}" for line in found]


if __name__ == "__main__":
    sys.exit(main())
