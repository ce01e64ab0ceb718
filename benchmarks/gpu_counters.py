"""Ask the hardware's counters about every kernel of a POP step, by Nsight Compute.

    python benchmarks/gpu_counters.py counters.json [--cases 270k_1.6MP] [--lines lines.csv.gz]

One step is launched kernel by kernel; the file has for each its time, launch, registers, instructions, and what its
warps wait for. `--lines` keeps the samples of every machine instruction of this project's kernels besides, which
`python -m cuda_ext.machine_code.hot_lines lines.csv.gz` lays on the lines of the source, also where there is no GPU.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import torch
from gpu_kernels import POP, about, make_trainer, photograph_of
from gpu_scenes import CASES, TINY, scenes

from cuda_ext.gpu_check.shared import ROOT, python_path
from pop_fast.children import python_command

WARM_UP: Final = 4  # steps before the one that is looked at
WAITS: Final = 4  # reasons that are kept of a kernel
# what is asked for: the name in the file, ncu's name, the factor to the file's unit
ASKED: Final = {
    "us": ("gpu__time_duration.sum", 1e-3),
    "grid": ("launch__grid_size", 1),
    "block": ("launch__block_size", 1),
    "registers": ("launch__registers_per_thread", 1),
    "instructions": ("smsp__inst_executed.sum", 1),
    "issue_percent": ("smsp__issue_active.avg.pct_of_peak_sustained_active", 1),
    "warps_percent": ("sm__warps_active.avg.pct_of_peak_sustained_active", 1),
    "memory_percent": ("gpu__compute_memory_throughput.avg.pct_of_peak_sustained_elapsed", 1),
    "cycles_active": ("sm__cycles_active.avg", 1),
    "cycles": ("sm__cycles_elapsed.max", 1),
}
STALL: Final = re.compile(r"smsp__average_warps_issue_stalled_(\w+)_per_issue_active\.ratio")
STALLS: Final = "regex:smsp__average_warps_issue_stalled_.*_per_issue_active.ratio"
# ncu's own numbers without a clock that it sets; only what the step itself launches
NCU: Final = ("ncu", "--clock-control", "none", "--profile-from-start", "off")


def one_step(name: str, device: torch.device) -> None:
    """Take one POP step of a case between the profiler's start and stop; for the process that ncu watches."""
    ((_, make),) = scenes([name], [], device, 0.0)
    case, scene = make()
    trainer = make_trainer(scene, photograph_of(scene, case), WARM_UP + 1, replay=False)
    trainer.run(WARM_UP, POP)
    torch.cuda.synchronize()
    torch.cuda.profiler.start()
    trainer.run(WARM_UP + 1, POP)
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()


def short_name(kernel: str) -> str:
    """Return a kernel's name as ncu prints it without namespaces that say nothing, types of numbers and arguments."""
    kernel = re.sub(r"<unnamed>::|\(anonymous namespace\)::|\((?:int|bool|pop::Collect)\)", "", kernel)
    depth = 0
    for at, letter in enumerate(kernel):
        depth += (letter == "<") - (letter == ">")
        if letter == "(" and depth == 0:
            return kernel[:at]
    return kernel


def of_kernels(lines: Iterable[str]) -> list[dict[str, Any]]:
    """Read ncu's table of one metric a line, and give the counters of every kernel in the order of launch.

    Raises:
        ValueError: what it printed is no such table, or lacks a counter.
    """
    table = csv.DictReader(line for line in lines if line.startswith('"'))
    found: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    try:
        for row in table:
            value = row["Metric Value"].replace(",", "")
            # ratios of kernels that issue nothing
            found[row["ID"], row["Kernel Name"]][row["Metric Name"]] = float(value) if value != "n/a" else 0.0
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"ncu's table cannot be read ({error!r}); it must be --csv with one metric a line") from error
    if not found:
        raise ValueError("ncu told of no kernel; its words are above")
    return [_of_kernel(name, metrics) for (_, name), metrics in found.items()]


def _of_kernel(name: str, metrics: dict[str, float]) -> dict[str, Any]:
    absent = [metric for metric, _ in ASKED.values() if metric not in metrics]
    if absent:
        raise ValueError(f"{short_name(name)}: ncu told nothing of {', '.join(absent)}")
    asked = {key: metrics[metric] * factor for key, (metric, factor) in ASKED.items()}
    busy = 100.0 * asked.pop("cycles_active") / max(asked.pop("cycles"), 1.0)
    whole = {key: int(asked[key]) for key in ("grid", "block", "registers", "instructions")}
    shares = {key: round(asked[key], 1) for key in asked if key.endswith("_percent")}
    waits = {found[1]: round(value, 2) for key, value in metrics.items() if (found := STALL.fullmatch(key))}
    most = dict(sorted(waits.items(), key=lambda item: -item[1])[:WAITS])
    times = {"kernel": short_name(name), "us": round(asked["us"], 3)}
    return {**times, **whole, **shares, "busy_percent": round(busy, 1), "warps_stalled_per_issue": most}


def as_json(head: dict[str, Any], kernels: list[dict[str, Any]]) -> str:
    """Lay the file out, one kernel a line."""
    lines = ",\n".join(json.dumps(kernel) for kernel in kernels)
    return json.dumps(head)[:-1] + f', "kernels": [\n{lines}\n]}}\n'


def _watched(words: list[str], args: argparse.Namespace) -> str:
    """Run this script under ncu and return what is printed."""
    script = (str(Path(__file__).resolve()), "--step", "--cases", args.cases, "--device", args.device)
    # in a rehearsal the emulator takes the GPU's place in this process too
    through = [str(args.through)] if args.through else []
    command = [*NCU, *words, *python_command(*through, *script)]
    # the scripts here import each other by their bare names
    path = {"PYTHONPATH": python_path(ROOT, ROOT / "benchmarks")}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=args.limit_s, env=os.environ | path
    )
    if done.returncode != 0:
        raise ValueError(f"ncu failed:\n{(done.stdout + done.stderr)[-1500:]}")
    return done.stdout


def _keep_lines(target: Path, args: argparse.Namespace) -> None:
    """Keep the samples of every instruction of this project's kernels."""
    report = target.with_name(target.name + ".ncu-rep")
    ours = ["-k", "regex:pop::", "--kernel-name-base", "demangled"]
    try:
        _watched(["--set", "full", *ours, "-f", "-o", str(report)], args)
        words = [NCU[0], "-i", str(report), "--page", "source", "--csv"]
        done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=args.limit_s)
    finally:
        report.unlink(missing_ok=True)
    with io.TextIOWrapper(gzip.open(target, "wb"), encoding="utf-8") as file:
        file.write(done.stdout)


def main() -> int:
    """Run the script from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", help="the JSON file")
    parser.add_argument("--cases", choices=[case.name for case in (*CASES, TINY)], default=CASES[0].name)
    parser.add_argument("--lines", type=Path, help="also keep the samples of every instruction, as csv.gz")
    parser.add_argument("--limit-s", type=float, default=120.0, help="seconds for each run of ncu; default 120")
    parser.add_argument("--device", default="cuda", help="where tensors are; the emulated kernels take cpu")
    parser.add_argument("--through", type=Path, help="a script that runs the step, as a rehearsal's does")
    parser.add_argument("--step", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.step:
        one_step(args.cases, torch.device(args.device))
        return 0
    if args.out is None:
        parser.error("name the JSON file")
    if shutil.which(NCU[0]) is None:
        print("gpu_counters: ncu was not found; install Nsight Compute", file=sys.stderr)
        return 2
    metrics = ",".join([*(metric for metric, _ in ASKED.values()), STALLS])
    try:
        printed = _watched(["--metrics", metrics, "--csv"], args)
        head = {**about(), "case": args.cases}
        head["tool"] = f"{' '.join(NCU)}, one POP step launched kernel by kernel"
        args.out.write_text(as_json(head, of_kernels(printed.splitlines())), encoding="utf-8")
        if args.lines is not None:
            _keep_lines(args.lines, args)
    except (ValueError, subprocess.SubprocessError) as error:
        print(f"gpu_counters: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
