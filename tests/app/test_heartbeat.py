"""Where nobody sees a bar, what is being done is told line by line."""

from __future__ import annotations

import io
import time
from pathlib import Path

import pytest

from pop_fast.cli import progress
from pop_fast.cli.progress import bars
from pop_fast.io import heartbeat
from pop_fast.io.heartbeat import Heartbeat, duration
from tests.app.conftest import TRAIN, Pop


def wait_for_a_line(capsys: pytest.CaptureFixture[str]) -> str:
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        told = capsys.readouterr().err
        if told:
            return told.splitlines()[0]
        time.sleep(0.005)
    raise AssertionError("nothing is told")


def test_a_line_comes_by_itself_from_within_a_long_computation(capsys: pytest.CaptureFixture[str]) -> None:
    with Heartbeat(period=0.01) as beat:
        beat.say("finding cameras: 3 of 25")
        assert wait_for_a_line(capsys) == "pop: finding cameras: 3 of 25 (0 s)"
    capsys.readouterr()
    time.sleep(0.05)
    assert capsys.readouterr().err == ""


def test_stages_that_report_are_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "PERIOD", 0.01)
    with bars() as report:
        report("matching photographs", 64, 1225)
        assert wait_for_a_line(capsys).startswith("pop: matching photographs: 64 of 1,225 (")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_time_that_is_left_is_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "PERIOD", 0.01)
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    with bars() as report:
        report("matching pairs of photographs", 0, 300)
        clock[0] += 60.0
        report("matching pairs of photographs", 100, 300)
        end = time.perf_counter() + 60.0
        told = ""
        while " left" not in told and time.perf_counter() < end:
            told = capsys.readouterr().err
    assert "pop: matching pairs of photographs: 100 of 300, 2 min 0 s left (" in told


@pytest.mark.parametrize("quiet", [True, False])
def test_a_terminal_and_a_quiet_run_are_told_nothing(monkeypatch: pytest.MonkeyPatch, quiet: bool) -> None:
    stream = io.StringIO() if quiet else Terminal()
    monkeypatch.setattr("sys.stderr", stream)
    with Heartbeat(show=not quiet, period=0.001) as beat:
        beat.say("reading")
        time.sleep(0.05)
    assert stream.getvalue() == ""


def test_training_tells_how_far_it_is(
    pop: Pop, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heartbeat, "PERIOD", 0.01)
    words = [word for word in TRAIN if word != "--no-progress"]
    told = pop("train", shared_capture, "--out", tmp_path / "r", *words)
    assert told.status == 0
    steps = [line for line in told.err.splitlines() if line.startswith("pop: step ")]
    assert steps
    assert all(" of 30, " in line and " Gaussians" in line and line.endswith(" s)") for line in steps)
    assert pop("train", shared_capture, "--out", tmp_path / "q", *TRAIN).err == ""


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (59.4, "59 s"), (59.6, "1 min 0 s"), (3599, "59 min 59 s"), (7860, "2 h 11 min")],
)
def test_times_are_written_as_people_say_them(seconds: float, words: str) -> None:
    assert duration(seconds) == words
