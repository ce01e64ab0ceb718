"""The stages of `gpu_check` that run tests: smoke, laws, steps, and tests under compute-sanitizer."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
from collections.abc import Mapping
from typing import Any

from cuda_ext.gpu_check.outcomes import FILE, outcomes
from cuda_ext.gpu_check.shared import NOTHING, ROOT, StageContext, skipped
from pop_fast.children import python_command

LAWS = ("test_laws.py",)
STEPS = tuple(f"test_{name}.py" for name in ("ten_steps", "instances", "kernels", "device_training"))
SMOKE = tuple(
    f"test_ten_steps.py::test_{name}"
    for name in (
        # replayed graphs first: nothing but a GPU can run them
        "steps_launched_anew_are_the_replayed_steps",
        "graphs_of_several_sizes_and_phases_are_replayed_in_turn",
        "two_runs_give_the_same_bits",
        "buffers_that_overflow_grow_and_nothing_is_lost",
        "ten_fused_steps_are_the_cpus_ten_steps",
    )
)
SMOKE += ("test_smoke.py",)
# no graph is captured, which cannot be where every allocation is one of the driver's
WATCHED = ("test_ten_steps.py::test_rasterization_and_its_gradients_give_the_same_bits_twice", "test_smoke.py")
LAWS_REHEARSED = "remaining_light_lies"


def smoke_stage(check: StageContext) -> dict[str, Any]:
    """Replay graphs, overflow buffers, compare ten steps with the CPU's and an image with the oracle's."""
    return _pytest(check, "smoke", SMOKE)


def laws_stage(check: StageContext) -> dict[str, Any]:
    """Hold every law of the kit, gradients and thresholds among them, to the CUDA backend."""
    return _laws(check, "laws", "pixel_parallel atomics")


def laws_of_gaussian_parallel_stage(check: StageContext) -> dict[str, Any]:
    """Hold the laws to the other backward kernel, which is not the default."""
    return _laws(check, "laws_of_gaussian_parallel", "gaussian_parallel")


def steps_stage(check: StageContext) -> dict[str, Any]:
    """Compare ten training steps with the CPU's, the bits of two runs, overflows, and short trainings with the CPU's.

    And hold single kernels, rows of every place and size, and other readings of the paper, to the CPU.
    """
    few = ("-k", "twice") if check.rehearsal else ()
    return _pytest(check, "steps", STEPS, *few)


def sanitizer_stage(check: StageContext) -> dict[str, Any]:
    """Run compute-sanitizer over a render, its gradients and fused steps; note where it cannot run."""
    tool = shutil.which("compute-sanitizer")
    if tool is None:
        return skipped("compute-sanitizer is not installed")
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
        # no more files are brought back than a node gives back
        (check.out / f"{name}.jsonl").unlink(missing_ok=True)
        found |= {kind: one, "status": found["status"] or one["status"]}
        found["seconds"] = round(found["seconds"] + one["seconds"], 1)
        check.note(found)
    return found


def _laws(check: StageContext, name: str, kinds: str) -> dict[str, Any]:
    if check.rehearsal:
        # all are collected, few are run
        few = ("-k", LAWS_REHEARSED)
        return _pytest(check, name, LAWS, *few, over={"POP_CUDA_KINDS": kinds, "POP_EMULATED_LAWS": "1"})
    # the oracle takes most of the time, so that several processes share the GPU without waiting for it
    workers = min((os.cpu_count() or 2) // 2, 8)
    several = ("-n", str(workers)) if workers > 1 and importlib.util.find_spec("xdist") else ()
    return _pytest(check, name, LAWS, *several, over={"POP_CUDA_KINDS": kinds})


def _pytest(
    check: StageContext,
    name: str,
    tests: tuple[str, ...],
    *options: str,
    before: tuple[str, ...] = (),
    limit: float | None = None,
    over: Mapping[str, str] = NOTHING,
) -> dict[str, Any]:
    """Run tests of the GPU's folder, in a rehearsal under the emulator, and add up how they ended."""
    chosen = [str(ROOT / "tests" / "cuda" / "gpu" / test) for test in tests]
    lines = check.out / f"{name}.jsonl"
    lines.unlink(missing_ok=True)
    words = python_command("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "cuda_ext.gpu_check.outcomes")
    on = "emulated" if check.rehearsal else "cuda"
    over = {"OMP_NUM_THREADS": "1" if check.rehearsal else "4", "POP_CUDA_ON": on, FILE: str(lines), **over}
    # interrupted, pytest says what it has seen so far
    found = check.run([*before, *words, *options, *chosen], limit or check.seconds, over, signal.SIGINT)
    found["tests"] = outcomes(lines)
    # without a GPU everything is skipped, which is no pass
    return found | {"status": found["status"] or int(found["tests"]["passed"] == 0)}
