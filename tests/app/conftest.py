"""The command line called in this process or in one of its own, and a tiny capture and result, made once a session."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from pop_fast.cli import main
from pop_fast.train import TrainingRun
from pop_fast.train import checkpoint as ckpt
from tests.app.tiny import run_until, tiny_capture, tiny_config

ROOT = Path(__file__).parents[2]


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


def done(outcome: Outcome) -> str:
    """Return what a call has printed that must have succeeded."""
    assert outcome.status == 0, outcome
    return outcome.out


def wait_until(found: Callable[[], Any], process: subprocess.Popen[str] | None = None) -> Any:
    """Wait until something is found, and return it; a process has to live so long."""
    # not the clock that tests set
    end = time.perf_counter() + 300.0
    while not (value := found()):
        assert process is None or process.poll() is None, process.communicate()
        assert time.perf_counter() < end, "it does not come to that"
        time.sleep(0.005)
    return value


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


# Calls in processes of their own: for input that could end the interpreter, and as torchrun starts them.


def in_a_child(script: str, *words: object, seconds: float = 300.0) -> Outcome:
    """Run a script with these words in `sys.argv[1:]`; a signal that ended it is a negative status."""
    command = [sys.executable, "-c", script, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False, cwd=ROOT)
    return Outcome(done.returncode, done.stdout, done.stderr)


def pop_in_a_child(*words: object) -> Outcome:
    """Call `pop WORD ...` in a process of its own."""
    return in_a_child("import sys; from pop_fast.cli import main; sys.exit(main(sys.argv[1:]))", *words)


def launched(words: Sequence[object], size: int = 2, seconds: float = 300.0) -> list[Outcome]:
    """Call `python WORD ...` in so many processes at once and return what each came to, by rank."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    together = {"WORLD_SIZE": size, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "OMP_NUM_THREADS": 1}
    started: list[subprocess.Popen[str]] = []
    try:
        for rank in range(size):
            told = {name: str(value) for name, value in {**together, "RANK": rank, "LOCAL_RANK": rank}.items()}
            command = [sys.executable, *map(str, words)]
            pipe, environment = subprocess.PIPE, {**os.environ, **told}
            child = subprocess.Popen(command, stdout=pipe, stderr=pipe, env=environment, cwd=ROOT, text=True)
            started.append(child)
        ended = [(child.communicate(timeout=seconds), child.returncode) for child in started]
    finally:
        for child in started:
            child.kill()
    return [Outcome(status, out, err) for (out, err), status in ended]
