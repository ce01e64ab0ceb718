"""`benchmarks/ab_benchmark.py`: ratios come from pairs of runs, and nothing is timed where the images differ."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "ab_benchmark.py"


@pytest.fixture(scope="module")
def ab_benchmark():
    spec = importlib.util.spec_from_file_location("ab_benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def timed(seconds, log, image=None):
    remaining = iter(seconds)

    def once():
        log.append(seconds)
        return (next(remaining),)

    return once, lambda: torch.zeros(2, 2, 3) if image is None else image


def test_each_repeat_gives_one_ratio_whatever_the_machine_does_between_repeats(ab_benchmark):
    # three warm-ups, then the machine is ten times slower in every other repeat; this one takes twice as long in all
    its, log = [1.0] * 3 + [0.001, 0.010] * 4, []
    mine = [1.0] * 3 + [2.0 * t for t in its[3:]]
    found = ab_benchmark.compare(timed(mine, log), timed(its, log), ("step",), 8)["step"]
    assert found["ratio"] == pytest.approx(2.0)
    assert found["ratio_quartiles"] == pytest.approx([2.0, 2.0])
    assert found["this_ms"] == pytest.approx(2.0 * found["other_ms"])
    # the order changes from repeat to repeat
    assert log[6:10] == [its, mine, mine, its] or log[6:10] == [mine, its, its, mine]


def test_nothing_is_timed_where_the_images_differ(ab_benchmark):
    log = []
    with pytest.raises(SystemExit, match=r"images differ by 5.0e-01, more than 1e-04; nothing was timed"):
        ab_benchmark.compare(timed([1.0], log), timed([1.0], log, torch.full((2, 2, 3), 0.5)), ("step",), 1)
    assert not log


def test_a_folder_that_is_no_checkout_is_named(ab_benchmark, tmp_path):
    with pytest.raises(SystemExit, match=rf"{tmp_path} has no pop_fast/__init__.py"):
        ab_benchmark.Checkout(tmp_path)


def test_what_a_function_imports_when_it_is_called_is_its_own_checkouts(ab_benchmark, tmp_path, monkeypatch):
    (tmp_path / "run.py").write_text("def name():\n    from pop_fast.late import NAME\n    return NAME\n")
    for name in ("one", "other"):
        package = tmp_path / name / "pop_fast"
        package.mkdir(parents=True)
        for file, words in {"__init__": "", "late": f"NAME = {name!r}\n"}.items():
            (package / f"{file}.py").write_text(words)
    monkeypatch.setattr(ab_benchmark, "HERE", tmp_path)
    loaded = ab_benchmark._forget()
    try:
        one, other = (ab_benchmark.Checkout(tmp_path / name) for name in ("one", "other"))
        for checkout, expected in [(one, "one"), (other, "other"), (one, "one")]:
            with checkout.imports():
                assert checkout.run.name() == expected
    finally:
        ab_benchmark._forget()
        sys.modules.update(loaded)
