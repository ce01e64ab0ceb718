"""The command line called in this process, and a tiny capture and result to call it on, made once a session."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from pop_fast.cli import main
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from tests.app.interruptions import run_until
from tests.app.tiny import tiny_capture, tiny_config


@dataclass(frozen=True)
class Outcome:
    """What a call of `pop` came to."""

    status: int
    out: str
    err: str


# a capture of 8 photographs; 30 steps with a change of the Gaussians and all else that density control does
TRAIN_AND_CHECK = ("--steps-scaler", "0.001", "--no-progress", "--pop.grow-grad2d", "1e-6")
# without the renders of the report, which take longer than all of the rest
TRAIN = (*TRAIN_AND_CHECK, "--skip-checks")


@dataclass(frozen=True)
class Pop:
    """Calls `pop WORD ...` in this process."""

    capsys: pytest.CaptureFixture[str]

    def __call__(self, *words: object) -> Outcome:
        """Call it and return what it came to."""
        self.capsys.readouterr()
        status = main([str(word) for word in words])
        out, err = self.capsys.readouterr()
        return Outcome(status, out, err)

    def done(self, *words: object) -> Outcome:
        """Call what must succeed."""
        outcome = self(*words)
        assert outcome.status == 0, outcome
        return outcome


@pytest.fixture
def pop(capsys: pytest.CaptureFixture[str]) -> Pop:
    """The command line, called in this process."""
    return Pop(capsys)


@pytest.fixture(scope="session")
def shared_capture(made_once: Callable[..., Path]) -> Path:
    """A tiny demo capture that tests only read."""

    def make(folder: Path) -> None:
        assert main(["demo", str(folder / "toy"), "--views", "8", "--width", "40", "--height", "32"]) == 0

    return made_once("capture", make) / "toy"


@pytest.fixture
def capture(shared_capture: Path, tmp_path: Path) -> Path:
    """A copy of the tiny capture that a test may damage."""
    return Path(shutil.copytree(shared_capture, tmp_path / "toy"))


@pytest.fixture(scope="session")
def shared_result(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """The result of training on the tiny capture, which tests only read."""

    def make(folder: Path) -> None:
        assert main(["train", str(shared_capture), "--out", str(folder / "toy_pop"), *TRAIN_AND_CHECK]) == 0

    return made_once("result", make) / "toy_pop"


@pytest.fixture
def result(shared_result: Path, tmp_path: Path) -> Path:
    """A copy of the tiny result that a test may damage or add to."""
    return Path(shutil.copytree(shared_result, tmp_path / "result"))


@pytest.fixture(scope="session")
def stopped(made_once: Callable[..., Path]) -> Path:
    """A run of thirty steps that was left after eleven: two checkpoints, after the fifth and the tenth."""
    folder = made_once("stopped", lambda folder: run_until(TrainingRun(tiny_config(folder), tiny_capture()), 11))
    assert [step for step, _ in ckpt.list_checkpoints(folder)] == [4, 9]
    return folder
