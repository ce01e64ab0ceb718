"""Damaged input, a failing disk and sudden ends, at a few places each; `python -m benchmarks.faults` tries them all."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.faults.fuzz import kept
from benchmarks.faults.readers import READERS
from tests.app.children import ROOT, in_a_child

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="children are forked, and limited as Linux does")


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("faults") / "faults.json"
    command = [sys.executable, "-m", "benchmarks.faults", "--quick", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, timeout=600)
    assert out.exists(), done.stderr[-3000:]
    found = json.loads(out.read_text())
    assert (done.returncode == 0) == ("nothing failed" in done.stdout)
    return found


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_is_read_or_refused_in_a_line(tried: dict[str, Any], reader: str) -> None:
    found = tried["fuzz"]["readers"][reader]
    assert sum(found.values()) == 10 + len(kept(reader))
    failures = {key: value for key, value in tried["fuzz"]["failures"].items() if key.startswith(f"{reader}: ")}
    assert found["escaped"] + found["crashed"] + found["hung"] == 0, failures
    assert found["refused"] > 0 or not READERS[reader].refuses


def test_inputs_that_once_broke_something_are_kept() -> None:
    assert sum(len(kept(reader)) for reader in READERS) >= 60


@pytest.mark.parametrize("job", ["train", "train --overwrite", "write a PLY"])
def test_a_process_that_ends_between_two_changes_of_the_disk_leaves_sound_files(
    tried: dict[str, Any], job: str
) -> None:
    found = tried["crashes"][job]
    assert found["failures"] == []
    assert found["ended"] == found["tried"] == 2
    assert found["points"] >= 4


@pytest.mark.parametrize("job", ["train", "train --overwrite", "write a PLY"])
def test_what_the_system_refuses_is_told_in_a_line_and_harms_nothing(tried: dict[str, Any], job: str) -> None:
    found = tried["writes"][job]
    assert found["failures"] == []
    # a run does without the flush of a folder
    assert found.get("told", 0) + found.get("continued", 0) == found["tried"] == 2
    assert "told" in found or job != "write a PLY"


def test_the_compiled_kernels_are_clean_under_sanitizers(tried: dict[str, Any]) -> None:
    found = tried["sanitizers"]
    if "skipped" in found:
        pytest.skip(f"{found['skipped']}; python -m benchmarks.faults --only sanitizers compiles it, in a minute")
    assert found["failures"] == []
    assert len(found["told"]) == 2


BAD = """
import json, os, sys, time
from pathlib import Path
import numpy as np
from benchmarks.faults import fuzz
from benchmarks.faults.readers import READERS, Reader
from pop_fast.errors import PopError

fuzz.SECONDS = 1

def raising(error):
    def read(path):
        raise error
    return read

def named(path):
    raise PopError(f"{path}: is damaged; copy it again")

BAD = {
    "named": named, "of no file": raising(PopError("is damaged")), "a fault": raising(KeyError("x")),
    "aborts": lambda path: os.abort(), "hangs": lambda path: time.sleep(60.0),
    "takes all memory": lambda path: np.ones(2**33, np.uint8), "ends": lambda path: os._exit(0),
}
READERS.clear()
READERS.update({name: Reader("photos/photo.png", "", read) for name, read in BAD.items()})
print(json.dumps(fuzz.fuzz(2, 0.0, 0)))
"""


def test_the_fuzzer_notices_what_readers_must_not_do() -> None:
    outcome = in_a_child(BAD)
    assert outcome.status == 0, outcome.err[-3000:]
    found = {name: {k: v for k, v in row.items() if v} for name, row in json.loads(outcome.out)["readers"].items()}
    assert found == {
        "named": {"refused": 2},
        "of no file": {"escaped": 2},
        "a fault": {"escaped": 2},
        "aborts": {"crashed": 2},
        "hangs": {"hung": 2},
        "takes all memory": {"escaped": 2},
        "ends": {"crashed": 2},
    }


def test_a_load_above_its_bound_fails(tmp_path: Path) -> None:
    script = """
import sys
from benchmarks import load
load.CASES = {"small": load.Case(3, 50, 64, 48)}
load.PROGRAM = 0.0
sys.exit(load.main(["--out", sys.argv[1]]))
"""
    outcome = in_a_child(script, tmp_path / "load.json")
    assert outcome.status == 1, outcome.err[-2000:]
    assert "small: above its bound" in outcome.out
    found = json.loads((tmp_path / "load.json").read_text())["cases"]["small"]
    # what torch and the program take by themselves
    assert 0.1 < found["peak_gib"] < 0.5
