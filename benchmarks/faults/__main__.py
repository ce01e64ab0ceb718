"""What the program does when its input is damaged, its disk fails, or it is killed.

python -m benchmarks.faults [--minutes M] [--only PART] [--quick] [--seed N] [--save] [--out FILE]

Runs the parts below, prints what failed, and writes benchmarks/results/faults.json, of which docs/reliability.md has
the tables; a part that is run alone replaces its own results, and so does a --reader or a --kind. With --minutes the
fuzzer and the kill loop share that time, or the one of them that runs has it; without, they stop after their least.
--save keeps the files that broke a reader among the regressions of benchmarks/faults/corpus. Runs are tried of every
--kind: by the native step, on two ranks and in blocks; --kills says how often each is killed at least, --places at how
many changes of the disk it is disturbed. --quick tries a few places of those parts that have no test of their own, as
the tests do, and writes to --out alone. What cannot be tried here is named, and what is known of its part stays. Exit
status 1 where anything failed.

    fuzz        mutated files to every reader, in children with limits of memory and time
    kills       SIGKILL at random moments of a run; continuing gives the same bits
    crashes     the process ends right before each rename, flush, new folder or file and removal, and in writes
    writes      the system refuses each of them
    flips       single bits of a checkpoint
    sanitizers  every unit of C++ with AddressSanitizer, UndefinedBehaviorSanitizer and ThreadSanitizer
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import cv2
import torch

from benchmarks.record import machine, read_json, write_json

from . import disk, fuzz, runs, sanitizers

RESULTS = Path(__file__).resolve().parents[1] / "results" / "faults.json"
PARTS = ("fuzz", "kills", "crashes", "writes", "flips", "sanitizers")
QUICK = ("fuzz", "crashes", "writes", "flips", "sanitizers")
KINDS = tuple(runs.KINDS)
# how often at least, and at how many places of a job at most; a run takes a second, two, and five
KILLS = {"native step": 50, "two ranks": 20, "blocks 2x1": 10}
PLACES = {"native step": None, "two ranks": 50, "blocks 2x1": 40}
QUICK_PLACES = {"native step": 2, "two ranks": 1, "blocks 2x1": 1}


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=0.0)
    parser.add_argument("--only", choices=PARTS, action="append")
    parser.add_argument("--reader", choices=tuple(fuzz.READERS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--kind", choices=KINDS, action="append")
    parser.add_argument("--kills", type=int)
    parser.add_argument("--places", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    # children that are forked must find no thread's locks taken
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    parts = args.only or (QUICK if args.quick else PARTS)
    args.minutes /= max(len({"fuzz", "kills"} & {*parts}), 1)
    now = machine()
    found = {part: _stamped(part, _run(part, args), now["commit"]) for part in parts}
    left_out = {part: _left_out(part, result) for part, result in found.items()}
    out = args.out or (None if args.quick else RESULTS)
    if out is not None:
        earlier = read_json(out)
        whole = {part: result for part, result in found.items() if not left_out[part] or part not in earlier}
        # kinds of runs, and a reader, that are tried alone replace their own results
        kept = {part: {**earlier.get(part, {}), **whole[part]} for part in whole if args.kind is not None}
        if args.reader is not None and "fuzz" in whole and "fuzz" in earlier:
            kept["fuzz"] = fuzz.renewed(earlier["fuzz"], whole["fuzz"])
        write_json(out, {**earlier, "machine": now, **whole, **kept})
    failed = [line for part, result in found.items() for line in _failures(part, result)]
    untried = [f"left out: {line}" for lines in left_out.values() for line in lines]
    print("\n".join([*(failed or ["nothing failed"]), *untried]))
    return 1 if failed else 0


def _stamped(part: str, result: dict[str, Any], commit: str) -> dict[str, Any]:
    """Note the commit with what may be replaced by itself: parts, and of runs every job."""
    if part in ("fuzz", "sanitizers"):
        return {**result, "commit": commit}
    return {job: {**row, "commit": commit} for job, row in result.items()}


def _left_out(part: str, result: dict[str, Any]) -> list[str]:
    """List what of a part could not be tried here, with the reason."""
    rows = {"sanitizers": result.get("checks", {}), "fuzz": {}}.get(part, result)
    return [f"{part}: {name}: {row['skipped']}" for name, row in rows.items() if "skipped" in row]


def _run(part: str, args: argparse.Namespace) -> dict[str, Any]:
    print(f"{part} ...", flush=True)
    if part == "fuzz":
        return fuzz.fuzz(10 if args.quick else 1_000, args.minutes, args.seed, args.reader, args.save)
    if part == "sanitizers":
        return sanitizers.sanitized(compile_first=not args.quick)
    reason = runs.why_not()
    if reason is not None:
        return {"runs": {"skipped": reason, "failures": []}}
    kinds = ("native step",) if part == "flips" else args.kind or KINDS
    return {name: result for kind in kinds for name, result in _of_kind(part, kind, args).items()}


def _of_kind(part: str, kind: str, args: argparse.Namespace) -> dict[str, Any]:
    share = args.minutes / len(args.kind or KINDS)
    with runs.scene(kind) as scene:
        if part == "kills":
            return {kind: runs.kill_loop(scene, 2 if args.quick else args.kills or KILLS[kind], share, args.seed)}
        if part == "flips":
            return {kind: disk.bit_flips(scene, 100 if args.quick else 5_000, args.seed)}
        work = disk.crash_points if part == "crashes" else disk.failing_writes
        found = work(scene, QUICK_PLACES[kind] if args.quick else args.places or PLACES[kind])
        return {f"{kind}: {job}": result for job, result in found.items()}


def _failures(part: str, result: dict[str, Any]) -> list[str]:
    if part in ("kills", "crashes", "writes", "flips"):
        return [f"{part}: {line}" for job in result.values() for line in job["failures"]]
    found = result["failures"]
    return [f"{part}: {line}: {found[line]}" if isinstance(found, dict) else f"{part}: {line}" for line in found]


if __name__ == "__main__":
    sys.exit(main())
