"""What the stages of `gpu_check` share: where things lie, how long there is, and how a command is run."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cuda_ext.gpu_check.tools import ROOT, Command, python_path, run
from pop_fast.children import python_command

NOTHING: Mapping[str, str] = MappingProxyType({})


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
        return python_command(*rehearse, *words)

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


def skipped(reason: str) -> dict[str, Any]:
    """Return what a stage found that had nothing to do, which is no failure."""
    return {"status": 0, "seconds": 0.0, "skipped": reason}
