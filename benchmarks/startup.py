"""From the command to what it does: the first step of `pop train`, help texts, a slip of the finger, `pop doctor`."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from pop_fast.children import python_command

ROOT = Path(__file__).resolve().parents[1]
# what the installed script `pop` runs
POP = python_command("-c", "import sys; from pop_fast.cli import main; sys.exit(main())")
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


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT)}


def _run(words: tuple[str, ...]) -> dict[str, float]:
    """Run a command to its end: wall and processor seconds."""
    before, start = _processor_seconds(), time.perf_counter()
    subprocess.run([*POP, *words], env=_environment(), capture_output=True, check=False)
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
            subprocess.Popen([*POP, *words, "--out", str(out)], env=_environment(), stdout=to, stderr=to) as running,
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
