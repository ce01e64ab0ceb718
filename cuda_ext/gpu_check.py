"""Everything that only a GPU can tell, in stages, into one JSON file: build, laws, bits, sanitizer, steps, benchmarks.

    python -m cuda_ext.gpu_check out.json [--stages build laws steps sanitizer bench] [--limit 540]

Stages add to the file, so that several calls of limited length can fill it. Exit status 1 when a stage failed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cuda_ext

ROOT = Path(__file__).resolve().parent.parent
GPU_TESTS = ROOT / "tests" / "cuda" / "gpu"
TAIL = 4000  # characters of a failing command that are kept


def _run(command: list[str], limit: float, **environment: str) -> dict[str, Any]:
    """Run a command in the repository and return its status, seconds and the end of its words."""
    start = time.monotonic()
    try:
        done = subprocess.run(
            command,
            cwd=ROOT,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=limit,
            env={**os.environ, **environment},
            check=False,
        )
        status, words = done.returncode, done.stdout
    except subprocess.TimeoutExpired as error:
        status, words = 124, str(error.stdout or "")
    return {"status": status, "seconds": round(time.monotonic() - start, 1), "output": words[-TAIL:]}


def _first_line(command: list[str]) -> str:
    if shutil.which(command[0]) is None:
        return "not found"
    done = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=False)
    return (done.stdout or done.stderr).strip()


def environment() -> dict[str, Any]:
    """Describe the machine, the driver, the versions and the commit."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.max.sm", "--format=csv,noheader"]
    told: dict[str, Any] = {
        "gpu": _first_line(query),
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "commit": _first_line(["git", "rev-parse", "HEAD"]),
        "dirty": bool(_first_line(["git", "status", "--porcelain"])),
    }
    try:
        import torch

        told["torch"] = torch.__version__
    except ImportError:
        told["torch"] = None
    return told


def build_stage(limit: float) -> dict[str, Any]:
    """Build the extension for this machine's GPU, and note registers and spills."""
    found = _run([sys.executable, "-m", "cuda_ext.build", "--jobs", str(os.cpu_count() or 2)], limit)
    if found["status"] == 0:
        found["why_not"] = cuda_ext.why_not()
        found["status"] = 1 if found["why_not"] else 0
    return found


def _pytest(limit: float, *arguments: str) -> dict[str, Any]:
    report = _run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments], limit, OMP_NUM_THREADS="4"
    )
    # without a GPU everything would be skipped, which is no pass
    report["why_not"] = cuda_ext.why_not()
    report["status"] = report["status"] or int(report["why_not"] is not None)
    return report


def laws_stage(limit: float) -> dict[str, Any]:
    """Hold every law of the kit, gradients and thresholds among them, to the CUDA backend."""
    return _pytest(limit, str(GPU_TESTS), "--ignore", str(GPU_TESTS / "test_ten_steps.py"))


def steps_stage(limit: float) -> dict[str, Any]:
    """Take ten training steps beside the CPU, twice for the same bits, and with buffers that overflow."""
    return _pytest(limit, str(GPU_TESTS / "test_ten_steps.py"))


def sanitizer_stage(limit: float) -> dict[str, Any]:
    """Run compute-sanitizer's memcheck and racecheck over ten small training steps; note where it cannot run."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return {"status": 0, "seconds": 0.0, "skipped": "compute-sanitizer is not installed"}
    found: dict[str, Any] = {"status": 0, "seconds": 0.0}
    test = f"{GPU_TESTS / 'test_ten_steps.py'}::test_rasterization_and_its_gradients_give_the_same_bits_twice"
    for check in ("memcheck", "racecheck"):
        command = [tool, "--tool", check, "--error-exitcode", "9", sys.executable, "-m", "pytest", "-q", test]
        one = _run(command, limit / 2)
        if "Device not supported" in one["output"]:
            one = {**one, "status": 0, "skipped": "compute-sanitizer does not support this device here"}
        found[check] = one
        found["status"] = found["status"] or one["status"]
        found["seconds"] += one["seconds"]
    return found


def bench_stage(limit: float) -> dict[str, Any]:
    """Time every kernel and the whole step, beside gsplat where it is installed."""
    target = ROOT / "out" / "gpu_bench.json"
    target.parent.mkdir(exist_ok=True)
    found = _run([sys.executable, str(ROOT / "benchmarks" / "gpu_kernels.py"), str(target)], limit)
    if found["status"] == 0:
        found["results"] = json.loads(target.read_text())
    return found


STAGES: dict[str, Callable[[float], dict[str, Any]]] = {
    "build": build_stage,
    "laws": laws_stage,
    "steps": steps_stage,
    "sanitizer": sanitizer_stage,
    "bench": bench_stage,
}


def main() -> int:
    """Run the stages from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the JSON file; stages of earlier calls in it are kept")
    parser.add_argument("--stages", nargs="+", choices=list(STAGES), default=list(STAGES), help="which, in this order")
    parser.add_argument("--limit", type=float, default=540.0, help="seconds for all stages of this call together")
    args = parser.parse_args()
    report: dict[str, Any] = json.loads(args.out.read_text()) if args.out.exists() else {"stages": {}}
    report["environment"] = environment()
    end = time.monotonic() + args.limit
    failed: list[str] = []
    for name in args.stages:
        left = end - time.monotonic()
        found = STAGES[name](left) if left > 1.0 else {"status": 124, "seconds": 0.0, "output": "no time was left"}
        report["stages"][name] = found
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(report, indent=1) + "\n")
        print(f"{name}: {'ok' if found['status'] == 0 else 'FAILED'} in {found['seconds']} s", flush=True)
        if found["status"] != 0:
            failed.append(name)
            print(found.get("why_not") or found.get("output", ""), flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
