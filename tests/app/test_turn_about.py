"""`benchmarks/turn_about.py`: ratios come from pairs of runs, and nothing is timed where the images differ."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "turn_about.py"


@pytest.fixture(scope="module")
def turn_about():
    spec = importlib.util.spec_from_file_location("turn_about", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def timed(seconds, log, image=None):
    remaining = iter(seconds)

    def once():
        log.append(seconds)
        return (next(remaining),)

    return once, lambda: torch.zeros(2, 2, 3) if image is None else image


def test_each_repeat_gives_one_ratio_whatever_the_machine_does_between_repeats(turn_about):
    # three warm-ups, then the machine is ten times slower in every other repeat; this one takes twice as long in all
    its, log = [1.0] * 3 + [0.001, 0.010] * 4, []
    mine = [1.0] * 3 + [2.0 * t for t in its[3:]]
    found = turn_about.compare(timed(mine, log), timed(its, log), ("step",), 8)["step"]
    assert found["ratio"] == pytest.approx(2.0)
    assert found["ratio_quartiles"] == pytest.approx([2.0, 2.0])
    assert found["this_ms"] == pytest.approx(2.0 * found["other_ms"])
    # the order changes from repeat to repeat
    assert log[6:10] == [its, mine, mine, its] or log[6:10] == [mine, its, its, mine]


def test_nothing_is_timed_where_the_images_differ(turn_about):
    log = []
    with pytest.raises(SystemExit, match=r"images differ by 5.0e-01, more than 1e-04; nothing was timed"):
        turn_about.compare(timed([1.0], log), timed([1.0], log, torch.full((2, 2, 3), 0.5)), ("step",), 1)
    assert not log


def test_a_folder_that_is_no_checkout_is_named(turn_about, tmp_path):
    with pytest.raises(SystemExit, match=rf"{tmp_path} has no pop_fast/__init__.py"):
        turn_about.Checkout(tmp_path)


def test_what_a_function_imports_when_it_is_called_is_its_own_checkouts(turn_about, tmp_path, monkeypatch):
    (tmp_path / "run.py").write_text("def name():\n    from pop_fast.late import NAME\n    return NAME\n")
    for name in ("one", "other"):
        package = tmp_path / name / "pop_fast"
        package.mkdir(parents=True)
        for file, words in {"__init__": "", "late": f"NAME = {name!r}\n"}.items():
            (package / f"{file}.py").write_text(words)
    monkeypatch.setattr(turn_about, "HERE", tmp_path)
    loaded = turn_about._forget()
    try:
        one, other = (turn_about.Checkout(tmp_path / name) for name in ("one", "other"))
        for checkout, expected in [(one, "one"), (other, "other"), (one, "one")]:
            with checkout.imports():
                assert checkout.run.name() == expected
    finally:
        turn_about._forget()
        sys.modules.update(loaded)
