"""The stages of `gpu_check`: what each runs, and what it keeps of it."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cuda_ext.gpu_check_budget import Share
from cuda_ext.gpu_check_outcomes import FILE, outcomes
from cuda_ext.gpu_check_tools import ROOT, Command, python_path, read_json, run

NOTHING: Mapping[str, str] = MappingProxyType({})
STEPS = ("test_ten_steps.py", "test_device_training.py")
SMOKE = tuple(
    f"test_ten_steps.py::test_{name}"
    for name in (
        # replayed graphs first: nothing but a GPU can run them
        *("steps_launched_anew_are_the_replayed_steps", "two_runs_give_the_same_bits"),
        *("buffers_that_overflow_grow_and_nothing_is_lost", "ten_fused_steps_are_the_cpus_ten_steps"),
    )
)
SMOKE += ("test_smoke.py",)
# no graph is captured, which cannot be where every allocation is one of the driver's
WATCHED = ("test_ten_steps.py::test_rasterization_and_its_gradients_give_the_same_bits_twice", "test_smoke.py")
LAWS_REHEARSED = "remaining_light_lies"
_TRAIN = "from pop_fast.cli import main; raise SystemExit(main())"
_COMPILE = "import time; t = time.time(); from gsplat.cuda._backend import _C; print(round(time.time() - t), 's');"
_COMPILE += "assert _C is not None, 'gsplat found no CUDA toolkit'"
# what a training run is judged by
_TOLD = ("step", "seconds", "seconds_loading", "seconds_total", "num_GS", "num_GS_above_floor", "psnr", "ssim", "views")
_TOLD += ("gpu", "gpu_memory_bytes", "instance_buffers_grown")


@dataclass(frozen=True)
class Check:
    """What the stages share.

    Attributes:
        seconds: that this stage may take.
        out: the folder of results.
        work: a folder for what is not brought back.
        log: what commands say goes there.
        packed: what was brought along (`--pack`), if anything.
        captures: folders to train on, besides those that were packed.
        steps_scaler: of the paper's 30,000 steps.
        commit: names trainings that may be gone on with.
        rehearsal: the emulator takes the GPU's place, with tiny cases.
        note: keeps what a stage has found so far.
        beside: commands that run beside the stages, by name.
    """

    seconds: float
    out: Path
    work: Path
    log: Path
    packed: Path | None
    captures: tuple[Path, ...]
    steps_scaler: float
    commit: str
    rehearsal: bool
    note: Callable[[dict[str, Any]], None]
    beside: dict[str, Command] = field(default_factory=dict)

    @property
    def site(self) -> Path:
        """Where packed wheels are installed."""
        return self.work / "site"

    def python(self, *words: str) -> list[str]:
        """Return the command that runs Python's `words`, with the emulator in the GPU's place in a rehearsal."""
        rehearse = [str(ROOT / "tests" / "cuda" / "emulated" / "rehearse.py")] if self.rehearsal else []
        return [sys.executable, *rehearse, *words]

    def run(
        self,
        words: list[str],
        limit: float,
        over: Mapping[str, str] = NOTHING,
        stop: signal.Signals = signal.SIGTERM,
    ) -> dict[str, Any]:
        """Run a command that finds the repository and the packed wheels, with `over` put over its environment."""
        path = python_path(ROOT, self.site)
        return run(words, limit, self.log, {"PYTHONPATH": path, "PYTHONUNBUFFERED": "1", **over}, stop)

    def scenes(self) -> list[str]:
        """List the packed scenes."""
        return sorted(map(str, (self.packed / "scenes").glob("*.npz"))) if self.packed else []


def wheels_stage(check: Check) -> dict[str, Any]:
    """Install the wheels that were brought along into a scratch folder; go on without what is absent."""
    wheels = sorted(map(str, (check.packed / "wheels").glob("*.whl"))) if check.packed else []
    if not wheels:
        return _skipped("no wheels were brought along (--packed FOLDER, made by --pack)")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--no-compile", "--upgrade"]
    return check.run([*pip, "--target", str(check.site), *wheels], check.seconds) | {"wheels": list(map(_stem, wheels))}


def build_stage(check: Check) -> dict[str, Any]:
    """Build the extension for this machine's GPU; what an earlier call built is only built where sources changed."""
    jobs = str(os.cpu_count() or 2)
    found = check.run(check.python("-m", "cuda_ext.build", "--jobs", jobs), check.seconds)
    if found["status"] == 0 and (check.site / "gsplat").is_dir():
        _start_gsplat(check)
    return found


def smoke_stage(check: Check) -> dict[str, Any]:
    """Replay graphs, overflow buffers, take ten steps beside the CPU, and draw an image beside the oracle's."""
    return _pytest(check, "smoke", SMOKE)


def bench_stage(check: Check) -> dict[str, Any]:
    """Time every kernel and the whole step."""
    return _benchmark(check, "gpu_kernels.py", check.seconds)


def gsplat_stage(check: Check) -> dict[str, Any]:
    """Time gsplat beside it, when its own compilation, begun beside earlier stages, has come to an end."""
    compiling = check.beside.get("gsplat")
    if compiling is None:
        return _skipped("gsplat is not among the wheels that were brought along, or nothing was built")
    start = time.monotonic()
    compiled = compiling.wait(0.6 * check.seconds)
    check.note({"status": compiled["status"], "seconds": compiled["seconds"], "compilation": compiled})
    if compiled["status"] != 0:
        reason = "gsplat was not compiled: its words are under `compilation`; name build and gsplat alone in a call"
        return _skipped(reason) | {"compilation": compiled}
    left = check.seconds - (time.monotonic() - start)
    found = _benchmark(check, "gpu_gsplat.py", left, _of_gsplat(check))
    return found | {"compilation": compiled}


def laws_stage(check: Check) -> dict[str, Any]:
    """Hold every law of the kit, gradients and thresholds among them, to the CUDA backend."""
    return _laws(check, "laws", "columns atomics")


def laws_of_splats_stage(check: Check) -> dict[str, Any]:
    """Hold the laws to the other backward family, which is not the default."""
    return _laws(check, "laws_of_splats", "splats")


def steps_stage(check: Check) -> dict[str, Any]:
    """Take ten training steps beside the CPU, the same bits twice, overflows, and short trainings beside the CPU's."""
    few = ("-k", "anew or twice or (events and pop)") if check.rehearsal else ()
    return _pytest(check, "steps", STEPS, *few)


def sanitizer_stage(check: Check) -> dict[str, Any]:
    """Run compute-sanitizer over a render, its gradients and fused steps; note where it cannot run."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return _skipped("compute-sanitizer is not installed")
    found: dict[str, Any] = {"status": 0, "seconds": 0.0}
    kinds = ("memcheck",) if check.rehearsal else ("memcheck", "racecheck", "synccheck")
    for k, kind in enumerate(kinds):
        # torch's cache of memory hides accesses beyond an array's end; API errors are torch's own questions
        before = (tool, "--tool", kind, "--report-api-errors", "no", "--error-exitcode", "9")
        limit = (check.seconds - found["seconds"]) / (len(kinds) - k)
        name, uncached = f"sanitizer_{kind}", {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
        one = _pytest(check, name, WATCHED, before=before, limit=limit, over=uncached)
        if "Device not supported" in one["output"]:
            one = {**one, "status": 0, "skipped": "compute-sanitizer does not support this device here"}
        found |= {kind: one, "status": found["status"] or one["status"]}
        found["seconds"] = round(found["seconds"] + one["seconds"], 1)
        check.note(found)
    return found


def train_stage(check: Check) -> dict[str, Any]:
    """Train POP on every capture as `pop train --backend cuda` does; seconds, Gaussians, PSNR, SSIM."""
    packed = sorted((check.packed / "captures").glob("*/")) if check.packed else []
    captures = [*packed, *check.captures]
    if not captures:
        return _skipped("no captures were given (--captures DIR ...) or brought along")
    if importlib.util.find_spec("tyro") is None and not (check.site / "tyro").is_dir():
        return _skipped(
            "`pop train` needs tyro, which is neither installed nor among the wheels that were brought along"
        )
    found: dict[str, Any] = {"status": 0, "seconds": 0.0, "runs": {}}
    for k, path in enumerate(captures):
        one = train_one(check, path, (check.seconds - found["seconds"]) / (len(captures) - k))
        found["runs"][path.name] = one
        found |= {"status": found["status"] or one["status"], "seconds": round(found["seconds"] + one["seconds"], 1)}
        check.note(found)
    return found


def train_one(check: Check, path: Path, limit: float, backend: str = "cuda") -> dict[str, Any]:
    """Train on one capture, or go on with the training of an earlier call at the same commit."""
    folder = check.work / f"{path.name}_{backend}_{check.steps_scaler:g}_{check.commit[:12]}"
    words = ["train", str(path), "--out", str(folder), "--backend", backend]
    words += ["--steps-scaler", str(check.steps_scaler), "--quiet", "--max-renders", "1"]
    words += ["--resume"] if (folder / "cfg.json").exists() else []
    found = check.run(check.python("-c", _TRAIN, *words), limit)
    stats = sorted((folder / "stats").glob("val_step*.json"), key=lambda file: int(file.stem.split("step")[1]))
    if found["status"] == 130:
        found |= {"status": 124, "note": "the time was up; where the folder survives, the next call goes on"}
    elif found["status"] == 0 and not stats:
        found["status"] = 1
    if not stats:
        return found
    told = read_json(stats[-1])
    result = {name: told.get(name) for name in _TOLD}
    return {**result, **found, "seconds_training": told.get("seconds")}


def _start_gsplat(check: Check) -> None:
    environment = {"PYTHONPATH": python_path(ROOT, check.site), **_of_gsplat(check)}
    command = [sys.executable, "-c", _COMPILE]
    check.beside["gsplat"] = Command(command, check.work / "gsplat_compilation.log", environment)


def _of_gsplat(check: Check) -> dict[str, str]:
    jobs = str(max((os.cpu_count() or 2) // 2, 1))
    return {"TORCH_EXTENSIONS_DIR": str(check.work / "torch_extensions"), "MAX_JOBS": jobs}


def _benchmark(check: Check, script: str, limit: float, over: Mapping[str, str] = NOTHING) -> dict[str, Any]:
    target = check.out / f"{script.removesuffix('.py')}.json"
    target.unlink(missing_ok=True)
    words = [str(ROOT / "benchmarks" / script), str(target), "--scenes", *check.scenes()]
    words += ["--device", "cpu", "--cases", "tiny", "--full-size", "3000"] if check.rehearsal else []
    found = check.run(check.python(*words), limit, over)
    # case by case: also what was measured before the time was up
    return found | {"results": read_json(target)}


def _laws(check: Check, name: str, kinds: str) -> dict[str, Any]:
    if check.rehearsal:
        # all are collected, few are run
        few = ("-k", LAWS_REHEARSED)
        return _pytest(check, name, LAWS, *few, over={"POP_CUDA_KINDS": kinds, "POP_EMULATED_LAWS": "1"})
    # the oracle takes most of the time, so that several processes share the GPU without waiting for it
    workers = min((os.cpu_count() or 2) // 2, 8)
    several = ("-n", str(workers)) if workers > 1 and importlib.util.find_spec("xdist") else ()
    return _pytest(check, name, LAWS, *several, over={"POP_CUDA_KINDS": kinds})


LAWS = tuple(f"test_gpu_{name}.py" for name in ("whole", "compositing", "dominance", "gradients", "agreement"))


def _pytest(
    check: Check,
    name: str,
    tests: tuple[str, ...],
    *options: str,
    before: tuple[str, ...] = (),
    limit: float | None = None,
    over: Mapping[str, str] = NOTHING,
) -> dict[str, Any]:
    """Run tests of the GPU's folder, or of the emulator's twin of it, and add up how they ended."""
    folder = ROOT / "tests" / "cuda" / ("emulated" if check.rehearsal else "gpu")
    chosen = [str(folder / (_emulated(test) if check.rehearsal else test)) for test in tests]
    told = check.out / f"{name}.jsonl"
    told.unlink(missing_ok=True)
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "cuda_ext.gpu_check_outcomes"]
    over = {"OMP_NUM_THREADS": "1" if check.rehearsal else "4", FILE: str(told), **over}
    # interrupted, pytest says what it has seen so far
    found = check.run([*before, *words, *options, *chosen], limit or check.seconds, over, signal.SIGINT)
    found["tests"] = outcomes(told)
    # without a GPU everything is skipped, which is no pass
    return found | {"status": found["status"] or int(found["tests"]["passed"] == 0)}


def _emulated(test: str) -> str:
    name = test.removeprefix("test_").removeprefix("gpu_").removeprefix("device_")
    return f"test_emulated_{name}"


def _skipped(reason: str) -> dict[str, Any]:
    return {"status": 0, "seconds": 0.0, "skipped": reason}


def _stem(path: str) -> str:
    return "-".join(Path(path).name.split("-")[:2])


STAGES: dict[str, Callable[[Check], dict[str, Any]]] = {
    "wheels": wheels_stage,
    "build": build_stage,
    "smoke": smoke_stage,
    "bench": bench_stage,
    "gsplat": gsplat_stage,
    "laws": laws_stage,
    "steps": steps_stage,
    "sanitizer": sanitizer_stage,
    "train": train_stage,
    "laws_of_splats": laws_of_splats_stage,
}
SHARES = {
    "wheels": Share(5, 40),
    "build": Share(100, 300),
    "smoke": Share(30, 90),
    "bench": Share(120, 330),
    "gsplat": Share(60, 1e9),
    "laws": Share(90, 150),
    "steps": Share(45, 90),
    "sanitizer": Share(40, 90),
    "train": Share(90, 250),
    "laws_of_splats": Share(20, 1e9),
}
JOBS = {
    1: ("wheels", "build", "smoke", "bench", "gsplat"),
    2: ("wheels", "build", "laws", "steps", "sanitizer", "train", "laws_of_splats"),
}
