"""Memory that a render or a training step takes at its peak, each in a process of its own."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cases import MEMORY_CASE, Case, gaussians_of
from raster import SCENE
from steps import run_of_case, take_turn

from pop_fast.api.backend import get_backend
from pop_fast.children import python_command
from pop_fast.train.environment import keep_freed_memory

HERE = Path(__file__).resolve().parent
GIB = 2**20  # kB, in which the system counts


def measure(what: str, by: str) -> dict[str, Any]:
    """Measure a render and its backward ("render"), or training steps ("step"), by a backend or engine."""
    code = (
        f"import sys; sys.path.insert(0, {str(HERE)!r}); import memory; memory.{what}_once(memory.MEMORY_CASE, {by!r})"
    )
    done = subprocess.run(python_command("-c", code), stdout=subprocess.PIPE, text=True, check=True)
    return {"what": what, "by": by, **asdict(MEMORY_CASE), **json.loads(done.stdout)}


def render_once(case: Case, backend: str) -> None:
    """Render a case and its backward once, and print the peak memory of this process as JSON."""
    scene = gaussians_of(case)
    leaves = {name: scene[name].requires_grad_() for name in SCENE}

    def render() -> dict[str, Any]:
        image, _, meta = get_backend(backend).rasterization(
            **{**scene, **leaves}, width=case.width, height=case.height, sh_degree=3, packed=False, dominance=True
        )
        image.square().mean().backward()
        return {"pairs_per_pixel": meta["n_pairs"] / (case.width * case.height)}

    _watched(render)


def step_once(case: Case, engine: str) -> None:
    """Take two training steps of a case, the second with all that the first has set up, and print the peak likewise."""
    keep_freed_memory()  # as `pop train` does
    with tempfile.TemporaryDirectory() as folder:
        run = run_of_case(case, folder, engine)

        def steps() -> dict[str, Any]:
            take_turn(run, 2, threads=0)
            return {"working_gib": run.stepper.fused.bytes / 2**30} if engine == "native" else {}

        _watched(steps)


def _watched(call: Callable[[], dict[str, Any]]) -> None:
    """Run a call and print how much memory was there before and at its peak, GiB."""
    # the peak so far is that of setting up; Linux forgets it when asked
    Path("/proc/self/clear_refs").write_text("5")
    before, start = _memory("VmRSS"), time.perf_counter()
    found = call()
    seconds = time.perf_counter() - start
    print(json.dumps({"peak_gib": _memory("VmHWM"), "before_gib": before, "seconds": seconds, **found}))


def _memory(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{field}:")) / GIB
