"""A training step while other processes never rest, and the share of the machine that is fair."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from steps import Maker, engines, take_turn
from timing import turns

from pop_fast.children import python_command
from pop_fast.train.environment import reproducible

PROCESSES, STEPS = 8, 5
BOUND = 1.5  # times the fair share
# ends with whoever started it, also where that is killed and cannot end it
LOOP = """
import os, sys
while os.getppid() == int(sys.argv[1]):
    for _ in range(1_000_000):
        pass
"""


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
