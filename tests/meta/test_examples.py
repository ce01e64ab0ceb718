"""The examples that tests draw are the same on every machine, whatever is installed or imported."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pop_ref.conformance.hypothesis_profiles import EXAMPLES

ROOT = Path(__file__).resolve().parents[2]
UNHEARD_OF = (0.1234567, -77123.25, 31.0625)


def drawn(count: int = 400) -> list[float]:
    found: list[float] = []

    @settings(max_examples=count)
    @given(st.floats(-1e6, 1e6))
    def collect(value: float) -> None:
        found.append(value)

    collect()
    return found


def test_the_constants_of_a_local_module_are_not_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = drawn()
    file = tmp_path / "a_local_module.py"
    file.write_text(f"VALUES = {UNHEARD_OF!r}\n")
    spec = importlib.util.spec_from_file_location("a_local_module", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "a_local_module", module)
    spec.loader.exec_module(module)
    after = drawn()
    assert not set(UNHEARD_OF) & set(after)
    assert after == before


@pytest.mark.parametrize("profile", [name for name in EXAMPLES if name != "explore"])
def test_every_profile_but_explore_ignores_seeds_and_what_earlier_runs_kept(profile: str) -> None:
    kept = settings.get_profile(profile)
    assert kept.derandomize
    assert kept.database is None
    assert kept.max_examples == EXAMPLES[profile]


def test_exploring_draws_by_the_seed(tmp_path: Path) -> None:
    test = tmp_path / "test_drawn.py"
    test.write_text(
        "from hypothesis import given, strategies as st\n"
        "from pop_ref.conformance.hypothesis_profiles import load_profile\n"
        "load_profile('explore')\n"
        "@given(st.integers(0, 10**9))\n"
        "def test_it(n):\n"
        "    print('drew', n)\n"
    )

    def under(seed: int) -> list[str]:
        command = [sys.executable, "-m", "pytest", "-s", "-q", f"--hypothesis-seed={seed}", str(test)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        told = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=True)
        return [line for line in told.stdout.splitlines() if "drew" in line]

    one = under(1)
    assert len(one) == EXAMPLES["explore"]
    assert under(1) == one
    assert under(2) != one
