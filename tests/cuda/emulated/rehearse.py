"""Run a Python command with the emulated kernels in the GPU's place: what `gpu_check --rehearse` puts before its own.

    python tests/cuda/emulated/rehearse.py SCRIPT ...  |  -m MODULE ...  |  -c CODE ...

Building the extension becomes building the emulated module. The card's clock, events and name are stand-ins, so that
times of a rehearsal mean nothing.
"""

from __future__ import annotations

import runpy
import sys
import time
import types
from pathlib import Path
from typing import Any

import pytest

from cuda_ext.host import emulate
from tests.cuda.conftest import FOLDER


class StandInEvent:
    """A CUDA event where everything is done at once."""

    def __init__(self, enable_timing: bool = False) -> None:
        self.at = 0.0

    def record(self) -> None:
        self.at = time.perf_counter()

    def synchronize(self) -> None:
        assert self.at > 0.0

    def elapsed_time(self, end: StandInEvent) -> float:
        return 1e3 * (end.at - self.at)


def stand_in_card(patch: pytest.MonkeyPatch) -> None:
    """Put stand-ins where the benchmark asks torch for the card."""
    import torch

    patch.setattr(torch.cuda, "Event", StandInEvent)
    patch.setattr(torch.cuda, "_sleep", lambda cycles: None)
    patch.setattr(torch.cuda, "synchronize", lambda device=None: None)
    for name in ("start", "stop"):
        patch.setattr(torch.cuda.profiler, name, lambda: None)
    properties = types.SimpleNamespace(multi_processor_count=2)
    patch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    patch.setattr(torch.cuda, "get_device_name", lambda device=None: "emulated")


def stand_in_engine(patch: pytest.MonkeyPatch) -> None:
    """Put the emulated GPU where `pop train` looks for one."""
    from pop_fast.train import engines
    from tests.cuda.conftest import emulated_engine

    patch.setattr(engines, "whole_engine", lambda backend: emulated_engine())


def shorten_the_benchmark(patch: pytest.MonkeyPatch) -> None:
    """Measure every part a few times only."""
    import gpu_kernels

    for name, value in {"WARM_UP": 1, "REPEATS": 1, "STEPS": 2}.items():
        patch.setattr(gpu_kernels, name, value)


def main(words: list[str]) -> Any:
    """Run the command."""
    import torch

    library = emulate.build(FOLDER)
    if words[:2] == ["-m", "cuda_ext.build"]:
        return print(library)
    torch.set_num_threads(1)
    patch = pytest.MonkeyPatch()
    emulate.install(patch, library)
    stand_in_card(patch)
    sys.argv = words
    if words[0] == "-c":
        stand_in_engine(patch)
        sys.argv = ["-c", *words[2:]]
        return exec(compile(words[1], "<rehearsal>", "exec"), {"__name__": "__main__"})
    if words[0] == "-m":
        sys.argv = words[1:]
        return runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    sys.path.insert(0, str(Path(words[0]).parent))
    shorten_the_benchmark(patch)
    # by name, so that what was shortened is what runs; gpu_gsplat takes its numbers from gpu_kernels
    module = sys.modules.get(Path(words[0]).stem) or __import__(Path(words[0]).stem)
    raise SystemExit(module.main())


if __name__ == "__main__":
    main(sys.argv[1:])
