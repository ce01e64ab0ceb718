"""What a run changes in its process: settings of torch that are put back, memory that is kept."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from pop_fast.train.environment import reproducible


def test_settings_of_torch_are_put_back_after_a_run():
    before = (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled())
    small = torch.full((4 * 65_536,), torch.finfo(torch.float32).tiny)
    with reproducible(2):
        assert torch.get_num_threads() == 2
        assert torch.are_deterministic_algorithms_enabled()
        assert (small * 0.5 == 0.0).all()
    assert (torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()) == before
    assert (small * 0.5 > 0.0).all()


def test_freed_memory_is_kept_and_so_not_asked_for_again():
    # in a process of its own: the setting is for good. 64 MB are 16,384 pages; the first few may still be new ones
    script = """
import resource, sys
import torch
from pop_fast.train.environment import keep_freed_memory
kept = sys.argv[1] == "keep" and keep_freed_memory()
for _ in range(12):
    torch.ones(16 << 20)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    torch.ones(16 << 20)
print(int(kept), resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""

    def run(mode: str) -> tuple[int, int]:
        environment = {**os.environ, "GLIBC_TUNABLES": "", "MALLOC_MMAP_MAX_": "65536"}
        done = subprocess.run(
            [sys.executable, "-c", script, mode], capture_output=True, text=True, check=True, env=environment
        )
        kept, faults = done.stdout.split()
        return int(kept), int(faults)

    kept, few = run("keep")
    if not kept:
        pytest.skip("the C library is not glibc, which alone has this setting")
    assert few < 0.05 * run("plain")[1]
