"""What a process takes as a whole: memory at its peak, time from a command to its first step, steps in busy company."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from cases import MEMORY_CASE, Case, gaussians_of, turns
from record import peak_bytes
from steps import SCENE, Maker, engines, run_of_case, take_turn

from pop_fast.api.backend import get_backend
from pop_fast.children import python_command
from pop_fast.train.environment import keep_freed_memory, reproducible

HERE = Path(__file__).resolve().parent
GIB = 2**30
# what the installed script `pop` runs
POP = python_command("-c", "import sys; from pop_fast.cli import main; sys.exit(main())")
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(HERE.parent)}
REPEATS = 5
LONGEST = 120.0  # s, after which a first step is given up
COMMANDS = {
    "pop --help": ("--help",),
    "pop train --help": ("train", "--help"),
    "pop trian": ("trian",),
    "pop train scene --max-stpes 10": ("train", "scene", "--max-stpes", "10"),
    "pop doctor": ("doctor",),
}
BOUNDS_S = {"first step": 2.0, "command": 1.0}
PROCESSES, STEPS = 8, 5
BOUND = 1.5  # times the fair share
# ends with whoever started it, also where that is killed and cannot end it
LOOP = """
import os, sys
while os.getppid() == int(sys.argv[1]):
    for _ in range(1_000_000):
        pass
"""


def measure(what: str, by: str) -> dict[str, Any]:
    """Measure a render and its backward ("render"), or training steps ("step"), by a backend or engine."""
    load = f"import sys; sys.path.insert(0, {str(HERE)!r}); import processes as p"
    code = f"{load}; p.{what}_once(p.MEMORY_CASE, {by!r})"
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
    before, start = peak_bytes("VmRSS") / GIB, time.perf_counter()
    found = call()
    seconds = time.perf_counter() - start
    print(json.dumps({"peak_gib": peak_bytes() / GIB, "before_gib": before, "seconds": seconds, **found}))


def time_startup(capture: str | None, factor: int) -> dict[str, Any]:
    """Time every command of `COMMANDS`, and the first step where there is a capture; the least of `REPEATS` each."""
    found: dict[str, Any] = {"repeats": REPEATS, "bounds_s": BOUNDS_S}
    found["commands"] = {name: _best([_run(words) for _ in range(REPEATS)]) for name, words in COMMANDS.items()}
    if capture is not None:
        taken = [_first_step(capture, factor) for _ in range(REPEATS)]
        found["first_step"] = {"capture": Path(capture).name, "factor": factor, **_best(taken)}
    return found


def _best(taken: list[dict[str, float]]) -> dict[str, float]:
    return {name: min(run[name] for run in taken) for name in taken[0]}


def _run(words: tuple[str, ...]) -> dict[str, float]:
    """Run a command to its end: wall and processor seconds."""
    before, start = _processor_seconds(), time.perf_counter()
    subprocess.run([*POP, *words], env=ENVIRONMENT, capture_output=True, check=False)
    wall = time.perf_counter() - start
    return {"wall_s": wall, "cpu_s": _processor_seconds() - before}


def _first_step(capture: str, factor: int) -> dict[str, float]:
    """Time from the command to the first record, which is written as soon as the first step has been taken."""
    with tempfile.TemporaryDirectory() as folder:
        out, said = Path(folder) / "run", Path(folder) / "said"
        # one step, or its record would wait for the others of its segment
        words = ["train", capture, "--factor", str(factor), "--preset", "quick", "--max-steps", "1", "--no-progress"]
        start = time.perf_counter()
        with (
            said.open("wb") as to,
            subprocess.Popen([*POP, *words, "--out", str(out)], env=ENVIRONMENT, stdout=to, stderr=to) as running,
        ):
            try:
                record = _wait_for_record(out / "metrics.jsonl", running, start + LONGEST)
                wall = time.perf_counter() - start
            except TimeoutError as error:
                raise SystemExit(f"{error}: {said.read_text(errors='replace')[-500:]}") from error
            finally:
                running.kill()
        return {"wall_s": wall, "step_s": record["seconds"]}


def _wait_for_record(path: Path, running: subprocess.Popen[bytes], until: float) -> dict[str, Any]:
    while time.perf_counter() < until:
        over = running.poll() is not None
        line = path.read_text() if path.exists() else ""
        if "\n" in line:
            return dict(json.loads(line.partition("\n")[0]))
        if over:
            raise TimeoutError("pop train ended without a record")
        time.sleep(0.002)
    raise TimeoutError("pop train took no step in time")


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@contextmanager
def busy_processes(n: int = PROCESSES) -> Iterator[None]:
    """Keep so many processes counting for as long as a block runs."""
    running: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(n):
            running.append(subprocess.Popen(python_command("-S", "-c", LOOP, str(os.getpid()))))
        time.sleep(1.0)  # until all have started
        yield
    finally:
        for process in running:
            process.kill()
        for process in running:
            process.wait()


def fair_factor(threads: int, cores: int, processes: int = PROCESSES) -> float:
    """Return how much longer work of some threads takes where all who want a core get the same share of them."""
    return max(1.0, (processes + threads) / cores)


def time_beside(name: str, make: Maker, repeats: int) -> dict[str, Any]:
    """Time steps alone and while other processes are busy.

    Means over all steps, as a step that is held up for long counts in full.

    Args:
        name: of what is trained.
        make: makes the run of an engine in a folder.
        repeats: turns of `STEPS` steps, alone and among them.
    """
    threads, cores = torch.get_num_threads(), os.cpu_count() or 1
    if threads > cores:
        raise SystemExit(f"{threads} threads have no fair share of {cores} cores; give --threads {cores} or less")
    with tempfile.TemporaryDirectory() as folder, reproducible(threads):
        runs = {engine: make(f"{folder}/{engine}", engine) for engine in engines() if engine != "fast"}
        takes: dict[str, Callable[[], None]] = {
            engine: lambda run=run: take_turn(run, STEPS, threads) for engine, run in runs.items()
        }
        alone = turns(takes, repeats)
        with busy_processes():
            beside = turns(takes, repeats)
    fair = fair_factor(threads, cores)
    found = {}
    for engine in runs:
        before, after = (1e3 * sum(taken[engine]) / (STEPS * repeats) for taken in (alone, beside))
        found[engine] = {"alone_ms": before, "beside_ms": after, "of_fair_share": after / (fair * before)}
    how = {"name": name, "processes": PROCESSES, "threads": threads, "cores": cores, "fair_factor": fair}
    return {**how, "bound": BOUND, "engines": found}
