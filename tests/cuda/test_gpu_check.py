"""The check of everything that needs a GPU, on a machine without one: its stages, its file, its limits."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pytest

from cuda_ext import gpu_check
from cuda_ext.gpu_check import Check, main, train_one
from cuda_ext.gpu_check_tools import run, write_json
from pop_fast.cli import main as pop


def check(limit: float = 60.0, **changes: object) -> Check:
    shared = {"captures": (), "steps_scaler": 1.0, "gsplat": "gsplat", "note": lambda found: None, **changes}
    return Check(time.monotonic() + limit, **shared)  # type: ignore[arg-type]


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Stages in the place of the real ones, which would compile."""
    made: dict[str, object] = {}
    monkeypatch.setattr(gpu_check, "STAGES", made)
    monkeypatch.setattr(gpu_check, "environment", lambda: {"gpu": "none"})
    return made


def test_a_stage_that_fails_takes_nothing_from_the_others(stages, tmp_path, capsys):
    out = tmp_path / "new" / "check.json"

    def raises(check):
        assert json.loads(out.read_text())["stages"]["build"] == {"status": 0, "seconds": 1.0}
        check.note({"status": 0, "seconds": 0.5, "half": True})
        assert json.loads(out.read_text())["stages"]["laws"]["half"]
        raise OSError("the card fell off")

    stages |= {"build": lambda check: {"status": 0, "seconds": 1.0}, "laws": raises}
    stages |= {"bench": lambda check: {"status": 0, "seconds": 2.0, "skipped": "nothing to do"}}
    assert main([str(out), "--stages", "build", "laws", "bench"]) == 1
    report = json.loads(out.read_text())
    assert report["environment"] == {"gpu": "none"}
    assert list(report["stages"]) == ["build", "laws", "bench"]
    assert "the card fell off" in report["stages"]["laws"]["output"]
    assert "laws: FAILED" in capsys.readouterr().out
    # a later call fills the same file
    stages["laws"] = lambda check: {"status": 0, "seconds": 3.0}
    assert main([str(out), "--stages", "laws"]) == 0
    assert [stage["status"] for stage in json.loads(out.read_text())["stages"].values()] == [0, 0, 0]


def test_a_call_without_time_says_so_for_every_stage(stages, tmp_path):
    stages["build"] = lambda check: pytest.fail("it must not be begun")
    assert main([str(tmp_path / "c.json"), "--limit-s", "0", "--stages", "build"]) == 1
    assert "no time was left" in json.loads((tmp_path / "c.json").read_text())["stages"]["build"]["output"]


def test_a_command_is_asked_to_stop_before_it_is_made_to(monkeypatch):
    monkeypatch.setattr("cuda_ext.gpu_check_tools.GRACE", 5.0)
    polite = (
        "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *a: (print('a checkpoint'), sys.exit(130)));"
        "print('begun', flush=True); time.sleep(60)"
    )
    found = run([sys.executable, "-c", polite], 7.0)
    assert found["status"] == 130
    assert found["output"].split("\n")[:2] == ["begun", "a checkpoint"]
    monkeypatch.setattr("cuda_ext.gpu_check_tools.GRACE", 0.5)
    deaf = (
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('begun', flush=True); time.sleep(60)"
    )
    found = run([sys.executable, "-c", deaf], 2.5)
    assert found["status"] == 124
    assert found["seconds"] < 30.0


def test_a_training_is_reported_with_its_loading_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_check, "OUT", tmp_path / "out")
    assert pop(["demo", str(tmp_path / "toy"), "--views", "8", "--width", "40", "--height", "32"]) == 0
    one = train_one(tmp_path / "toy", 120.0, 0.001, backend="fast")
    assert one["status"] == 0, one["output"]
    assert one["step"] == 29
    assert one["psnr"] > 5.0
    assert 0.0 < one["ssim"] < 1.0
    assert one["num_GS"] > 0
    assert 0.0 < one["seconds_training"] < one["seconds"]
    assert one["seconds_loading"] > 0.0


def test_a_training_that_cannot_be_says_why_and_the_next_is_begun(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_check, "OUT", tmp_path / "out")
    notes: list[dict[str, object]] = []
    missing = (tmp_path / "a", tmp_path / "b")
    found = gpu_check.train_stage(check(captures=missing, note=lambda told: notes.append(json.loads(json.dumps(told)))))
    assert found["status"] != 0
    assert [list(note["runs"]) for note in notes] == [["a"], ["a", "b"]]  # type: ignore[call-overload]
    assert all("pop: error: " in one["output"] for one in found["runs"].values())
    assert "no captures" in gpu_check.train_stage(check())["skipped"]


def test_gsplat_that_cannot_be_installed_is_no_failure(monkeypatch):
    monkeypatch.setattr(gpu_check, "run", lambda *a, **k: {"status": 1, "seconds": 0.1, "output": "x\nno network\n"})
    found = gpu_check.gsplat_stage(check())
    assert (found["status"], found["skipped"]) == (0, "gsplat cannot be installed here: no network")
    monkeypatch.setattr(gpu_check, "run", lambda *a, **k: {"status": 0, "seconds": 0.1, "output": "1.5.3\n"})
    assert gpu_check.gsplat_stage(check())["version"] == "1.5.3"


def test_a_file_is_written_whole(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"k": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"k": object()})
    assert json.loads((tmp_path / "a.json").read_text()) == {"k": 1}
