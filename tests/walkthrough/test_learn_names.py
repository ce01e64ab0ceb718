"""What a learner is told of names that are nearly right, and of code that does not come to an end."""

from __future__ import annotations

from pathlib import Path

import pytest

from pop_ref.learn import __main__ as alone
from pop_ref.learn import stubs
from pop_ref.learn.course import BY_NAME
from pop_ref.learn.judge import judge, told
from pop_ref.learn.student import read_work

ALPHA = BY_NAME["alpha"]
STUB = 'raise NotImplementedError("{} is yours to write")'


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    stubs.start(tmp_path / "mine")
    return tmp_path / "mine"


def edited(folder: Path, *changes: tuple[str, str]) -> None:
    path = folder / ALPHA.file
    text = path.read_text()
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path.write_text(text)


def test_a_function_that_is_named_nearly_right_is_named(mine: Path) -> None:
    edited(mine, ("def falloff(", "def fallof("), (STUB.format("falloff"), "return 1.0"))
    edited(mine, ("def sigma_at_pixel(", "def weighted("), (STUB.format("sigma_at_pixel"), "return 1.0"))
    verdict = judge(read_work(mine), ALPHA)
    assert verdict.misspelt == {"falloff": "fallof"}
    assert verdict.unwritten == ALPHA.names
    assert "alpha.py has fallof: rename it if it is meant as falloff" in told(ALPHA, verdict)


def test_stubs_as_they_were_written_are_alike_to_nothing(mine: Path) -> None:
    work = read_work(mine)
    assert [judge(work, stage).misspelt for stage in BY_NAME.values()] == [{}] * len(BY_NAME)


@pytest.mark.parametrize("every", [False, True])
def test_what_takes_long_is_named_with_the_way_out(
    mine, monkeypatch, capsys: pytest.CaptureFixture[str], every
) -> None:
    monkeypatch.setattr(alone, "_LONG_S", 0.2)
    slow = "import time\n    time.sleep(1.0)\n    return 0.0"
    edited(mine, (STUB.format("sigma_at_pixel"), slow))
    assert alone.main(["check", *(["--all"] if every else ["alpha"]), str(mine)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "sigma_at_pixel of alpha.py" in line]
    assert lines[0].startswith("pop-learn: judging sigma_at_pixel of alpha.py takes more than 0.2 seconds")
    assert lines[0].endswith("Ctrl-C stops it")


def test_what_ends_soon_is_judged_without_a_word(mine: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edited(mine, (STUB.format("sigma_at_pixel"), "return 0.0"))
    assert alone.main(["check", "alpha", str(mine)]) == 1
    assert capsys.readouterr().err == ""
