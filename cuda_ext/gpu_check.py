"""Everything that only a GPU can tell, in stages, into one JSON file: build, laws, steps, sanitizer, training, bench.

    python -m cuda_ext.gpu_check out.json [--stages build laws ...] [--captures DIR ...] [--limit-s 540]

The file is written after every stage, and what earlier calls put into it stays, so that several calls of limited length
can fill it; a training that is cut off goes on in the next call. A stage that fails takes nothing from the others. Exit
status 1 when one failed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cuda_ext
from cuda_ext.gpu_check_tools import ROOT, first_line, python_path, run, write_json

GPU_TESTS = ROOT / "tests" / "cuda" / "gpu"
STEPS = ("test_ten_steps.py", "test_device_training.py")
OUT = ROOT / "out" / "gpu_check"
SITE = OUT / "site"  # gsplat, for the comparison alone
_POP = "from pop_fast.cli import main; raise SystemExit(main())"
# what a training run is judged by
_TOLD = ("step", "seconds", "seconds_loading", "seconds_total", "num_GS", "num_GS_above_floor", "psnr", "ssim", "views")
_TOLD += ("gpu", "gpu_memory_bytes", "instance_buffers_grown")


@dataclass(frozen=True)
class Check:
    """What the stages share.

    Attributes:
        end: when all stages must be done, by `time.monotonic`.
        captures: folders to train on.
        steps_scaler: of the paper's 30,000 steps.
        gsplat: what pip is to install for the comparison: a name or a wheel's path.
        note: keeps what a stage has found so far.
    """

    end: float
    captures: tuple[Path, ...]
    steps_scaler: float
    gsplat: str
    note: Callable[[dict[str, Any]], None]

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.end - time.monotonic()


def environment() -> dict[str, Any]:
    """Describe the machine, the driver, the versions and the commit."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.max.sm", "--format=csv,noheader"]
    told: dict[str, Any] = {
        "gpu": first_line(query),
        "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "commit": first_line(["git", "rev-parse", "HEAD"]),
        "dirty": bool(first_line(["git", "status", "--porcelain"])),
    }
    try:
        import torch

        told["torch"] = torch.__version__
    except ImportError:
        told["torch"] = None
    return told


def build_stage(check: Check) -> dict[str, Any]:
    """Build the extension for this machine's GPU."""
    found = run([sys.executable, "-m", "cuda_ext.build", "--jobs", str(os.cpu_count() or 2)], check.left)
    return _needs_a_gpu(found)


def laws_stage(check: Check) -> dict[str, Any]:
    """Hold every law of the kit, gradients and thresholds among them, to the CUDA backend."""
    return _laws(check, "columns atomics")


def laws_of_splats_stage(check: Check) -> dict[str, Any]:
    """Hold the laws to the other backward family, which is not the default."""
    return _laws(check, "splats")


def steps_stage(check: Check) -> dict[str, Any]:
    """Take ten training steps beside the CPU, the same bits twice, overflows, and short trainings beside the CPU's."""
    return _pytest(check, *(str(GPU_TESTS / name) for name in STEPS))


def sanitizer_stage(check: Check) -> dict[str, Any]:
    """Run compute-sanitizer's memcheck and racecheck over a render and its gradients; note where it cannot run."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return {"status": 0, "seconds": 0.0, "skipped": "compute-sanitizer is not installed"}
    found: dict[str, Any] = {"status": 0, "seconds": 0.0}
    test = f"{GPU_TESTS / STEPS[0]}::test_rasterization_and_its_gradients_give_the_same_bits_twice"
    share = check.left / 2
    for kind in ("memcheck", "racecheck"):
        command = [tool, "--tool", kind, "--error-exitcode", "9", sys.executable, "-m", "pytest", "-q", test]
        one = run(command, min(share, check.left))
        if "Device not supported" in one["output"]:
            one = {**one, "status": 0, "skipped": "compute-sanitizer does not support this device here"}
        found |= {kind: one, "status": found["status"] or one["status"], "seconds": found["seconds"] + one["seconds"]}
        check.note(found)
    return found


def gsplat_stage(check: Check) -> dict[str, Any]:
    """Get gsplat to compare with, into a folder of its own; where that cannot be, keep the reason: it is no failure."""
    probe = [sys.executable, "-c", "import gsplat; print(gsplat.__version__)"]
    pip = [sys.executable, "-m", "pip", "install", "-q", "--upgrade", "--target", str(SITE)]
    path = {"PYTHONPATH": python_path(SITE)}
    found = run(probe, check.left, **path)
    if found["status"] != 0:
        # not its dependencies: torch, which is here, would come along once more
        found = run([*pip, "--no-deps", check.gsplat], check.left)
        found = found if found["status"] else run([*pip, "jaxtyping", "rich", "ninja"], check.left)
        found = found if found["status"] else run(probe, check.left, **path)
    lines = [line for line in found["output"].splitlines() if line.strip()]
    last = lines[-1] if lines else "no words"
    if found["status"] == 0:
        return {**found, "version": last}
    return {**found, "status": 0, "skipped": f"gsplat cannot be installed here: {last}"}


def bench_stage(check: Check) -> dict[str, Any]:
    """Time every kernel and the whole step, beside gsplat where it is installed, also on what stage train has made."""
    target = OUT / "bench.json"
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)
    commit = first_line(["git", "rev-parse", "--short", "HEAD"])
    runs = sorted(str(file.parent) for file in OUT.glob(f"*_cuda_*_{commit}/cfg.json"))
    command = [sys.executable, str(ROOT / "benchmarks" / "gpu_kernels.py"), str(target), "--runs", *runs]
    found = run(command, check.left, PYTHONPATH=python_path(ROOT, SITE))
    if target.exists():
        # case by case: also what was measured before the time was up
        found["results"] = json.loads(target.read_text())
    return _needs_a_gpu(found)


def train_stage(check: Check) -> dict[str, Any]:
    """Train POP on every capture as `pop train --backend cuda` does; seconds, Gaussians, PSNR, SSIM."""
    if not check.captures:
        return {"status": 0, "seconds": 0.0, "skipped": "no captures were given (--captures DIR ...)"}
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "runs": {}}
    for path in check.captures:
        one = train_one(path, check.left, check.steps_scaler)
        found["runs"][path.name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def train_one(path: Path, limit: float, steps_scaler: float, backend: str = "cuda") -> dict[str, Any]:
    """Train on one capture, or go on with the training of an earlier call at the same commit."""
    commit = first_line(["git", "rev-parse", "--short", "HEAD"])
    folder = OUT / f"{path.name}_{backend}_{steps_scaler:g}_{commit}"
    words = ["train", str(path), "--out", str(folder), "--backend", backend, "--steps-scaler", str(steps_scaler)]
    words += ["--quiet", "--max-renders", "1", *(["--resume"] if (folder / "cfg.json").exists() else [])]
    found = run([sys.executable, "-c", _POP, *words], limit)
    if found["status"] == 130:
        return {**found, "status": 124, "note": "the time was up; the next call goes on from the checkpoint"}
    stats = sorted((folder / "stats").glob("val_step*.json"), key=lambda file: int(file.stem.split("step")[1]))
    if found["status"] != 0 or not stats:
        return {**found, "status": found["status"] or 1}
    told = json.loads(stats[-1].read_text())
    result = {name: told.get(name) for name in _TOLD}
    return {**found, **result, "seconds": found["seconds"], "seconds_training": told["seconds"]}


def _laws(check: Check, kinds: str) -> dict[str, Any]:
    ignored = (f"--ignore={GPU_TESTS / name}" for name in STEPS)
    return _pytest(check, str(GPU_TESTS), *ignored, POP_CUDA_KINDS=kinds)


def _pytest(check: Check, *arguments: str, **environment: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *arguments]
    # without a GPU everything would be skipped, which is no pass
    return _needs_a_gpu(run(command, check.left, OMP_NUM_THREADS="4", **environment))


def _needs_a_gpu(found: dict[str, Any]) -> dict[str, Any]:
    reason = cuda_ext.why_not()
    return {**found, "why_not": reason, "status": found["status"] or int(reason is not None)}


STAGES: dict[str, Callable[[Check], dict[str, Any]]] = {
    "build": build_stage,
    "laws": laws_stage,
    "laws_of_splats": laws_of_splats_stage,
    "steps": steps_stage,
    "sanitizer": sanitizer_stage,
    "train": train_stage,
    "gsplat": gsplat_stage,
    "bench": bench_stage,
}


def main(argv: list[str] | None = None) -> int:
    """Run the stages from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="the JSON file; stages of earlier calls in it are kept")
    parser.add_argument("--stages", nargs="+", choices=list(STAGES), default=list(STAGES), help="which, in this order")
    parser.add_argument("--limit-s", type=float, default=540.0, help="seconds for all stages of this call together")
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="folders to train on, for stage train")
    parser.add_argument("--steps-scaler", type=float, default=1.0, help="of 30,000 steps, for stage train")
    parser.add_argument("--gsplat", default="gsplat", help="what pip installs for the comparison, or a wheel's path")
    args = parser.parse_args(argv)
    report: dict[str, Any] = json.loads(args.out.read_text()) if args.out.exists() else {"stages": {}}
    report["environment"] = environment()
    end = time.monotonic() + args.limit_s
    failed: list[str] = []
    for name in args.stages:

        def note(found: dict[str, Any], name: str = name) -> None:
            report["stages"][name] = found
            write_json(args.out, report)

        check = Check(end, tuple(path.resolve() for path in args.captures), args.steps_scaler, args.gsplat, note)
        found = _held(STAGES[name], check)
        note(found)
        words = "skipped" if "skipped" in found else "ok" if found["status"] == 0 else "FAILED"
        print(f"{name}: {words} in {found['seconds']} s", flush=True)
        if found["status"] != 0:
            failed.append(name)
        if words != "ok":
            print(found.get("skipped") or found.get("why_not") or found.get("output", ""), flush=True)
    return 1 if failed else 0


def _held(stage: Callable[[Check], dict[str, Any]], check: Check) -> dict[str, Any]:
    """Run a stage; what it raises is kept, and does not reach the other stages."""
    if check.left < 1.0:
        return {"status": 124, "seconds": 0.0, "output": "no time was left; name the stage in another call"}
    start = time.monotonic()
    try:
        return stage(check)
    except Exception:
        return {"status": 1, "seconds": round(time.monotonic() - start, 1), "output": traceback.format_exc()}


if __name__ == "__main__":
    sys.exit(main())
