"""One run at a time in a result folder, and the next one as soon as that has ended, however it ended."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pop_fast.errors import PopError
from pop_fast.io.atomic import FolderLock
from pop_fast.train import TrainingRun
from pop_fast.train.results import ResultFolder
from tests.app.captures import assert_one_line
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents
from tests.app.interruptions import interrupt
from tests.app.tiny import tiny_capture, tiny_config

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no flock")
_HOLD = """
import sys, time
from pathlib import Path
from pop_fast.io.atomic import FolderLock
FolderLock(Path(sys.argv[1])).take()
print("held", flush=True)
time.sleep(300.0)
"""


def begin(results: ResultFolder, overwrite: bool = False) -> None:
    results.begin(tiny_config(results.path), {}, np.full(3, 0.5), overwrite)


@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_run_beside_a_live_one_is_refused_and_the_next_after_it_is_not(
    pop: Pop, shared_capture: Path, result: Path, how: str
) -> None:
    before = contents(result)
    with subprocess.Popen([sys.executable, "-c", _HOLD, str(result)], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        outcome = pop("train", shared_capture, "--out", result, *TRAIN, how)
        assert outcome.status == 2
        assert "another run is writing to this folder" in outcome.err
        assert contents(result) == before
        os.kill(holder.pid, signal.SIGKILL)
    assert pop("train", shared_capture, "--out", result, *TRAIN, how).status == 0


def test_of_two_that_found_no_folder_one_gets_it(tmp_path: Path) -> None:
    first, second = ResultFolder(tmp_path / "r"), ResultFolder(tmp_path / "r")
    for results in (first, second):
        results.hold()
        results.check(resume=False, overwrite=False)
    begin(first)
    with pytest.raises(PopError, match="another run is writing"):
        begin(second)
    first.close()
    # by then the folder holds the results of the first
    assert_one_line(lambda: begin(second), str(tmp_path / "r"), "another run has begun in this folder")


def test_a_run_that_stops_or_ends_gives_the_folder_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        interrupt(patch, at=7)
        with pytest.raises(KeyboardInterrupt):
            TrainingRun(tiny_config(tmp_path), tiny_capture()).run()
    lock = FolderLock(tmp_path)
    lock.take()
    lock.release()
    TrainingRun(tiny_config(tmp_path), tiny_capture(), resume=True).run()
    lock.take()
    assert lock.held
    with pytest.raises(PopError):
        FolderLock(tmp_path).take()
    lock.release()
    assert not lock.held


def test_nothing_is_left_in_the_folder_for_it(tmp_path: Path) -> None:
    lock = FolderLock(tmp_path)
    lock.take()
    assert list(tmp_path.iterdir()) == []
    lock.release()
    # what is wrong with a folder is said by who writes to it
    FolderLock(tmp_path / "absent").take()
