"""No command runs a module that lies in the current folder, nor does any process that a command starts."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import numpy as np
import pytest

from paper_repro.cli import COMMANDS as REPRO_COMMANDS
from pop_fast.children import module_command, python_command
from pop_fast.cli import COMMANDS
from tests.app.captures import write_photograph
from tests.app.children import ROOT

PLANTED = "with open({marker!r}, 'a') as file:\n    file.write(__name__ + '\\n')\nraise ImportError('planted')\n"
# what pip installs as `pop` and `pop-repro`, for several calls one after the other
SCRIPT = """
import json, sys, time
import paper_repro.cli, pop_fast.cli
for program, words in json.loads(sys.argv[1]):
    print(program, *words, file=sys.stderr, flush=True)
    status = (pop_fast if program == "pop" else paper_repro).cli.main(words)
    print("status", status, round(time.process_time(), 1), file=sys.stderr, flush=True)
"""
# of most, an input that is not there: what is imported before it is missed is enough
WORDS = {
    "train": "absent",
    "eval": "result --factor x",
    "render": "absent",
    "view": "result --host 192.0.2.1",
    "explain": "absent --pixel 3,3",
    "export": "result --to spz --out a.spz",
    "convert": "absent.ply --to spz",
    "compare": "absent",
    "report": "absent",
    "frames": "absent.mp4",
    "sfm": "photos --out found",
    "demo": "again --views 4 --width 16 --height 16",
    "data check": "cap",
    "blocks": "train absent 0_0",
    "build-cpu": "--help",
    "build-cuda": "--help",
    "learn": "map",
    "vectors": "check absent absent",
    "completion": "bash",
    "doctor": "",
}
REPRO_WORDS = {
    "run": "pop fox --scale small --data absent --results results --work work",
    "queue": "--scale small --rows pop --scenes fox --data absent --results results --work work",
    "verify": "pop fox --scale small --data absent --results absent",
    "status": "--scale toy --results results",
    "table": "1 --scale toy --results results --out tables",
    "figure": "7 --scale toy --results results --work work --out figures",
    "claims": "--scale toy --results results",
    "data check": "--data absent",
}


@pytest.fixture
def planted(tmp_path: Path) -> tuple[Path, Path]:
    """A folder with a module of every name that there is to import, and the file in which those that run sign."""
    folder, marker = tmp_path / "capture", tmp_path / "ran"
    folder.mkdir()
    ours = {"pop_ref", "pop_fast", "cuda_ext", "paper_repro", "benchmarks", "tests", "sitecustomize", "usercustomize"}
    # distributions name files and folders of theirs too that are no modules
    names = {name for name in {*sys.stdlib_module_names, *packages_distributions(), *ours} if name.isidentifier()}
    assert len(names) > 300
    for name in names:
        (folder / f"{name}.py").write_text(PLANTED.format(marker=str(marker)))
    return folder, marker


def call(folder: Path, calls: list[tuple[str, list[str]]], before: str = "") -> str:
    """Make calls of the command lines in a process whose current folder it is; return what it printed."""
    script = folder.parent / "bin" / "pop"
    script.parent.mkdir()
    script.write_text(before + SCRIPT)
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONSAFEPATH", "PYTHONPATH")}
    # a checkout that was never installed is found as well
    environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script), json.dumps(calls)]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    done = subprocess.run(command, cwd=folder, env=environment, timeout=300, **output)
    assert done.returncode == 0, done.stdout
    return done.stdout


def test_the_planted_modules_run_where_python_takes_the_current_folder(planted: tuple[Path, Path]) -> None:
    folder, marker = planted
    for words in (["-m", "pop_fast"], ["-c", "import cv2"]):
        subprocess.run([sys.executable, *words], cwd=folder, capture_output=True)
    assert {"cv2"} < set(marker.read_text().splitlines())


@pytest.mark.parametrize("command", [python_command("-c", "import pop_fast.cli"), module_command("pop_fast.cli", "-V")])
def test_the_command_of_a_child_leaves_it_out(planted: tuple[Path, Path], command: list[str]) -> None:
    folder, marker = planted
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not marker.exists()


def test_no_command_runs_a_module_of_the_current_folder(
    planted: tuple[Path, Path], shared_capture: Path, shared_result: Path
) -> None:
    folder, marker = planted
    assert WORDS.keys() == COMMANDS.keys()
    assert REPRO_WORDS.keys() == REPRO_COMMANDS.keys()
    (folder / "cap").symlink_to(shared_capture)
    (folder / "result").symlink_to(shared_result)
    (folder / "photos").mkdir()
    rng = np.random.default_rng(0)
    for k in range(3):
        write_photograph(folder / "photos" / f"{k}.jpg", rng.integers(0, 256, (48, 64, 3), np.uint8))
    calls = [("pop", [*name.split(), *words.split()]) for name, words in WORDS.items()]
    calls += [("pop-repro", [*name.split(), *words.split()]) for name, words in REPRO_WORDS.items()]
    said = call(folder, calls)
    assert not marker.exists(), f"{marker.read_text()}\n{said}"
    assert said.count("\nstatus ") == len(calls), said
    # of the commands that start processes, those had begun
    assert "[1/1] pop fox --scale small --seed 42 failed with status 2" in said, said
    assert "no cameras could be found for these 3 photographs" in said, said


# the first child comes to its end at once
ENDED = """
import shutil, sys
def hook(event, args):
    if event == "subprocess.Popen" and "blocks" in args[1]:
        shutil.rmtree("out/blocks")
sys.addaudithook(hook)
"""


def test_no_child_of_a_training_in_blocks_does(planted: tuple[Path, Path], shared_capture: Path) -> None:
    folder, marker = planted
    (folder / "cap").symlink_to(shared_capture)
    words = ["train", "cap", "--out", "out", "--blocks", "2x1", "--max-steps", "10", "--skip-checks", "--no-progress"]
    said = call(folder, [("pop", words)], ENDED)
    assert not marker.exists(), f"{marker.read_text()}\n{said}"
    # said by the child itself
    assert "out: is no run in blocks" in said, said
