"""Ctrl-C, SIGTERM, SIGHUP and SIGKILL, at a program that is at work in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from pop_fast.api.backend import get_backend
from pop_fast.train import TrainingRun, training_run
from pop_fast.train import checkpoint as ckpt
from tests.app.captures import PINHOLE, camera, photograph, ring, write_model, write_photograph
from tests.app.conftest import TRAIN, in_a_child
from tests.app.damage import contents
from tests.app.tiny import last_checkpoint, tiny_capture, tiny_config

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals")
_POP = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from pop_fast.cli import main
sys.exit(main())
"""


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Photographs of noise that overlap: thousands of features each, minutes of matching."""
    wall = np.random.default_rng(0).integers(0, 256, (900, 3000, 3), dtype=np.uint8)
    for i in range(24):
        write_photograph(tmp_path / "in" / f"{i:02d}.png", wall[:, 80 * i : 80 * i + 1100])
    return tmp_path / "in"


def start(tmp_path: Path, *words: object) -> subprocess.Popen[str]:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(scratch), "OMP_NUM_THREADS": "1"}
    # whoever runs the tests without a terminal may have hangups ignored, which children inherit
    heeding = "import signal; signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    command = [sys.executable, "-c", heeding + _POP, *map(str, words)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=environment, text=True, cwd=ROOT, **pipes)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str] | None = None) -> None:
    end = time.monotonic() + 90.0
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, "it does not come to that"
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_the_search_for_cameras_is_left_at_once_and_leaves_nothing(
    photographs: Path, tmp_path: Path, number: signal.Signals, status: int
) -> None:
    before = contents(photographs)
    process = start(tmp_path, "sfm", photographs)
    # while features are found, in one call of COLMAP that takes longer than the test waits
    wait_until(lambda: any((tmp_path / "scratch").glob("pop_sfm_*/database.db")), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == status
    if number != signal.SIGKILL:
        assert err == "pop: interrupted\n"
        assert contents(photographs) == before
    # the other process notices that this one is gone, whatever ended it
    wait_until(lambda: not any((tmp_path / "scratch").iterdir()))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_training_that_is_told_to_stop_writes_a_checkpoint(
    shared_capture: Path, tmp_path: Path, number: signal.Signals
) -> None:
    folder = tmp_path / "r"
    words = ("--max-steps", "100000", "--checkpoint-every", "0", *TRAIN)
    process = start(tmp_path, "train", shared_capture, "--out", folder, *words)
    wait_until(lambda: (folder / "cfg.json").exists(), process)
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130
    ((step, _),) = ckpt.list_checkpoints(folder)
    assert err == f"pop: stopped after step {step + 1:,}; the same command with --resume continues\n"


def test_a_hangup_that_is_ignored_stays_so(shared_capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / "r"
    ignoring = (
        "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    )
    command = [sys.executable, "-c", _POP, "train", str(shared_capture), "--out", str(folder), "--max-steps", "600"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-c", ignoring, *command, *TRAIN], env=environment, cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    wait_until(lambda: (folder / "cfg.json").exists(), process)
    process.send_signal(signal.SIGHUP)
    out, _ = process.communicate(timeout=300)
    assert process.returncode == 0
    assert "report: " in out


_LOADING = """
import atexit, os, time
from pathlib import Path

class Large:
    # taken apart when Python ends in its own way, as all that a training holds would be
    def __del__(self, write=os.write):
        write(1, b"taken apart")

large = Large()
atexit.register(print, "what was registered for the end is done")

from pop_fast.data import load
from pop_fast.data.cameras import require_colmap

def slowly(*_, **__):
    require_colmap()
    Path(sys.argv[-1], "reading").touch()
    time.sleep(300.0)

load.load_capture = slowly
"""


def test_sigterm_while_a_capture_is_read_is_one_line_and_the_end(shared_capture: Path, tmp_path: Path) -> None:
    script = _POP.replace("from pop_fast.cli import main", f"{_LOADING}from pop_fast.cli import main")
    # pycolmap prints a stack trace of its own where it is let
    words = ["train", str(shared_capture), "--out", f"{tmp_path}/r", "--images", str(tmp_path)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen([sys.executable, "-c", script, *words], text=True, cwd=ROOT, **pipes)
    wait_until(lambda: (tmp_path / "reading").exists(), process)
    process.terminate()
    out, err = process.communicate(timeout=60)
    assert err == "pop: interrupted\n"
    assert out == "what was registered for the end is done\n"
    assert process.returncode == 143


@pytest.mark.slow  # photographs of 12 megapixels
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_training_on_photographs_of_12_megapixels_is_gone_after_less_than_two_seconds_of_work(
    tmp_path: Path, number: signal.Signals
) -> None:
    reason = get_backend("compiled").why_not()
    if reason is not None:
        pytest.skip(reason)
    names, folder = [f"{i}.bmp" for i in range(6)], tmp_path / "r"
    for i, name in enumerate(names):
        write_photograph(tmp_path / "large" / "images" / name, photograph(i, 4000, 3000))
    wide = camera(params=[100.0 * value for value in PINHOLE], width=4000, height=3000)
    write_model(tmp_path / "large" / "sparse" / "0", names, ring(len(names)), [wide])
    words = ("--out", folder, "--max-steps", "1000", "--test-every", "0", "--no-progress", "--quiet")
    process = start(tmp_path, "train", tmp_path / "large", *words)
    wait_until(lambda: (folder / "metrics.jsonl").exists(), process)
    before = sum(map(int, Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[11:13]))
    process.send_signal(number)
    # by what it does and not by the clock, which depends on who else is at work
    _, status, used = os.wait4(process.pid, 0)
    assert os.waitstatus_to_exitcode(status) == 130
    ((step, _),) = ckpt.list_checkpoints(folder)
    assert process.stderr is not None
    assert process.stderr.read() == f"pop: stopped after step {step + 1:,}; the same command with --resume continues\n"
    assert used.ru_utime + used.ru_stime - before / os.sysconf("SC_CLK_TCK") < 2.0


# the handler runs between any two lines of what the main thread is doing: here at each line of the wait in turn
_AT_EVERY_LINE = """
import signal, sys
from pop_fast.blocks import jobs

jobs._PAUSE = 0.01
SLEEPER = [sys.executable, "-IS", "-c", "import time; time.sleep(100.0)"]

def status_after_a_signal_at(line):
    seen = 0

    def trace(frame, event, argument):
        nonlocal seen
        caller = frame
        while caller is not None and caller.f_code is not jobs._run.__code__:
            caller = caller.f_back
        if event == "line" and caller is not None and "process" in caller.f_locals:
            seen += 1
            if seen == line:
                signal.raise_signal(signal.SIGTERM)
        return trace

    sys.settrace(trace)
    try:
        return jobs._run(SLEEPER, True)
    finally:
        sys.settrace(None)

print(*[status_after_a_signal_at(line) for line in range(1, 61)])
"""


def test_a_request_to_stop_is_heard_at_every_line_of_waiting_for_a_process() -> None:
    outcome = in_a_child(_AT_EVERY_LINE, seconds=120.0)
    assert outcome.status == 0, outcome.err
    assert outcome.out.split() == ["130"] * 60


_IN_A_CALL = """
import ctypes, os, signal, threading, time
from pop_fast.train.signals import Abandoned, heard, stop_requests

def seconds_until_left(call):
    start = time.monotonic()
    with stop_requests() as stop:
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
        try:
            with stop.abandoning():
                call()
        except Abandoned:
            return time.monotonic() - start
    raise SystemExit("nobody was heard")

# as long as a call of compiled code, in which Python runs no handler
pthread_mutex = ctypes.create_string_buffer(64)
library = ctypes.CDLL(None)
library.pthread_mutex_init(pthread_mutex, None)
library.pthread_mutex_lock(pthread_mutex)
threading.Timer(2.5, library.pthread_mutex_unlock, (pthread_mutex,)).start()
print(seconds_until_left(lambda: heard(library.pthread_mutex_lock, pthread_mutex)), flush=True)
"""


def test_a_signal_is_heard_through_a_call_of_compiled_code() -> None:
    outcome = in_a_child(_IN_A_CALL, seconds=60.0)
    assert outcome.status == 0, outcome.err
    assert float(outcome.out) < 2.0


@pytest.mark.parametrize("engine", ["fast", "compiled"])
def test_a_measurement_that_is_left_is_made_by_who_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str
) -> None:
    reason = get_backend(engine).why_not()
    if reason is not None:
        pytest.skip(reason)
    whole = tiny_config(tmp_path / "whole", eval_steps=(12,), backend=engine)
    TrainingRun(whole, tiny_capture()).run()
    parts = replace(whole, result_dir=str(tmp_path / "parts"))
    measured = training_run.evaluate

    def asking(*given: Any) -> Any:
        # the last argument is the step, from 0
        if given[-1] == due - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return measured(*given)

    for due in (12, 30):
        with monkeypatch.context() as patch:
            patch.setattr(training_run, "evaluate", asking)
            with pytest.raises(KeyboardInterrupt):
                TrainingRun(parts, tiny_capture(), resume=due == 30).run()
        assert ckpt.list_checkpoints(tmp_path / "parts")[-1][0] == due - 1
        assert not (tmp_path / "parts" / "stats" / f"val_step{due - 1:04d}.json").exists()
    TrainingRun(parts, tiny_capture(), resume=True).run()
    for step in (11, 29):
        mine, theirs = (
            json.loads((tmp_path / name / "stats" / f"val_step{step:04d}.json").read_text())
            for name in ("parts", "whole")
        )
        assert mine["psnr"] == theirs["psnr"]
        assert mine["per_view"] == theirs["per_view"]
    mine, theirs = (last_checkpoint(tmp_path / name)[".splats.means"] for name in ("parts", "whole"))
    assert torch.equal(mine, theirs)
