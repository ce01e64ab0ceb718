"""The check of everything that needs a GPU, on a machine without one: its stages, its files, its limits."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cuda_ext.gpu_check import __main__ as gpu_check
from cuda_ext.gpu_check import shared as gpu_check_tools
from cuda_ext.gpu_check import stages as gpu_check_stages
from cuda_ext.gpu_check.__main__ import commit_of, main
from cuda_ext.gpu_check.outcomes import outcomes
from cuda_ext.gpu_check.shared import MARGIN, Budget, Command, Share, StageContext, first_line, run, write_json
from cuda_ext.gpu_check.stages import JOBS, SHARES, STAGES, train_one, wheels_stage
from paper_repro.results import from_line
from pop_fast.cli import main as pop
from pop_fast.data import load_capture
from tests.app.captures import colmap_capture
from tests.cuda.test_bare_node import stand_in_gsplat, stand_in_tool


def check(folder: Path, **changes: object) -> StageContext:
    shared = {"seconds": 60.0, "out": folder, "work": folder / "work", "log": folder / "log", "packed": None}
    shared |= {"captures": (), "steps_scaler": 1.0, "commit": "c0ffee", "rehearsal": False, "note": lambda found: None}
    return StageContext(**{**shared, **changes})


@pytest.fixture
def stages(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    """Stages in the place of the real ones, which would compile."""
    made: dict[str, object] = {}
    monkeypatch.setattr(gpu_check, "STAGES", made)
    monkeypatch.setattr(gpu_check, "environment", lambda commit: {"commit": commit})
    return made


def report(folder: Path, job: int = 1) -> dict[str, dict[str, dict[str, object]]]:
    return json.loads((folder / f"gpu_check_{job}.json").read_text())


def test_a_stage_that_fails_takes_nothing_from_the_others(stages, tmp_path, capsys):
    out = tmp_path / "new"

    def raises(check):
        assert report(out)["stages"]["build"] == {"status": 0, "seconds": 1.0}
        assert report(out)["stages"]["bench"] == {"status": None, "state": "not begun"}
        check.note({"status": 0, "seconds": 0.5, "half": True})
        assert report(out)["stages"]["laws"]["half"]
        assert not report(out)["complete"]
        raise OSError("the card fell off")

    stages |= {"build": lambda check: {"status": 0, "seconds": 1.0}, "laws": raises}
    stages |= {"bench": lambda check: {"status": 0, "seconds": 2.0, "skipped": "nothing to do"}}
    assert main([str(out), "--stages", "build", "laws", "bench"]) == 1
    found = report(out)
    assert found["complete"]
    assert list(found["stages"]) == ["build", "laws", "bench"]
    assert "the card fell off" in found["stages"]["laws"]["output"]
    said = capsys.readouterr().out
    assert "laws: FAILED" in said
    assert said.endswith("failed: laws; skipped: bench\n")
    assert main([str(out), "--stages", "bench"]) == 0
    assert capsys.readouterr().out.endswith("gpu_check_1.json: none failed; skipped: bench\n")
    # a later call fills the same file
    stages["laws"] = lambda check: {"status": 0, "seconds": 3.0}
    assert main([str(out), "--stages", "laws"]) == 0
    assert capsys.readouterr().out.endswith("gpu_check_1.json: every stage ran\n")
    assert [stage["status"] for stage in report(out)["stages"].values()] == [0, 0, 0]


def test_results_go_where_the_environment_says(stages, tmp_path, monkeypatch):
    stages["build"] = lambda check: {"status": 0, "seconds": 1.0}
    monkeypatch.setenv("OUT", str(tmp_path / "results"))
    assert main(["--stages", "build"]) == 0
    assert report(tmp_path / "results")["stages"]["build"]["status"] == 0
    assert main([str(tmp_path / "named"), "--stages", "build", "--job", "2"]) == 0
    assert report(tmp_path / "named", 2)["job"] == 2
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit, match="is a file; name a folder"):
        main([str(tmp_path / "file"), "--stages", "build"])
    with pytest.raises(SystemExit, match="x: Not a directory; name another folder"):
        main([str(tmp_path / "file" / "x"), "--stages", "build"])


def test_a_call_without_time_says_so_for_every_stage(stages, tmp_path):
    stages["build"] = lambda check: pytest.fail("it must not be begun")
    assert main([str(tmp_path), "--limit-s", "0", "--stages", "build"]) == 1
    assert "no time was left" in report(tmp_path)["stages"]["build"]["output"]


def test_a_stage_that_runs_out_of_time_says_so_and_a_machine_without_a_gpu_is_told(
    stages, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(gpu_check, "environment", lambda commit: {"gpu": None})
    stages["build"] = lambda check: check.run([sys.executable, "-c", "import time; time.sleep(60)"], 0.5)
    assert main([str(tmp_path), "--stages", "build"]) == 1
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("note: nvidia-smi names no GPU here")
    assert said[2] == report(tmp_path)["stages"]["build"]["note"] == "its time, 0 s, was up"
    with pytest.raises(SystemExit, match="--limit-s is nan"):
        main([str(tmp_path), "--limit-s", "nan"])


def test_no_stage_takes_what_later_ones_need():
    shares = {"build": Share(100, 300), "bench": Share(120, 1e9), "gsplat": Share(60, 1e9)}
    budget = Budget(560.0, shares, list(shares))
    assert budget.seconds("build") == pytest.approx(300.0, abs=0.5)
    assert budget.seconds("bench") == pytest.approx(560.0 - MARGIN - 60.0, abs=0.5)
    assert budget.seconds("gsplat") == pytest.approx(560.0 - MARGIN, abs=0.5)
    # a short call starves none either
    short = Budget(100.0 + MARGIN, shares, list(shares))
    kept = 0.9 * 100.0 / 280.0
    assert short.seconds("build") == pytest.approx(100.0 - 180.0 * kept, abs=0.5)
    assert short.seconds("bench") == pytest.approx(100.0 - 60.0 * kept, abs=0.5)
    for job in JOBS.values():
        # however long the stages before it take, each is left its least
        assert sum(SHARES[name].least for name in job) < 500.0
    assert set(STAGES) == set(SHARES) == {name for job in JOBS.values() for name in job}


def begun(code: str, tmp_path: Path) -> Command:
    """Begin a command, and wait until it has made the file that it is to make when it is ready to be stopped."""
    ready = tmp_path / "ready"
    ready.unlink(missing_ok=True)
    command = Command(
        [sys.executable, "-c", f"import pathlib, signal, sys, time\n{code}", str(ready)], tmp_path / "log"
    )
    while not ready.exists():
        time.sleep(0.05)
    return command


def test_a_command_is_asked_to_stop_before_it_is_made_to(tmp_path):
    wait = "print('begun', flush=True); pathlib.Path(sys.argv[1]).touch(); time.sleep(600)"
    polite = f"signal.signal(signal.SIGTERM, lambda *_: (print('a checkpoint'), sys.exit(130)))\n{wait}"
    found = begun(polite, tmp_path).wait(60.0, grace=60.0)
    assert (found["status"], found["output"]) == (130, "begun\na checkpoint\n")
    interrupted = f"try: {wait}\nexcept KeyboardInterrupt: print('a summary'); raise SystemExit(2)"
    found = begun(interrupted, tmp_path).wait(60.0, signal.SIGINT, grace=60.0)
    assert (found["status"], found["output"]) == (2, "begun\na summary\n")
    deaf = f"signal.signal(signal.SIGTERM, signal.SIG_IGN)\n{wait}"
    found = begun(deaf, tmp_path).wait(0.5, grace=0.5)
    assert (found["status"], found["output"], found["note"]) == (124, "begun\n", "its time, 0 s, was up")
    # each command's words stand in the log, and only its own in what is returned
    assert (tmp_path / "log").read_text().count("$ ") == 3


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_job_that_is_ended_takes_its_commands_along(tmp_path, ending):
    mark = tmp_path / "begun"
    script = (f"echo $$ > {mark}.partial", f"mv {mark}.partial {mark}", "exec sleep 60")
    path = stand_in_tool(tmp_path / "bin" / "compute-sanitizer", "#!/bin/sh", *script)
    words = [sys.executable, "-m", "cuda_ext.gpu_check", str(tmp_path / "out"), "--stages", "sanitizer"]

    def listen() -> None:  # what starts the tests may ignore it
        signal.signal(ending, signal.SIG_DFL)

    over = {**os.environ, **path}
    with subprocess.Popen(words, cwd=gpu_check_tools.ROOT, env=over, preexec_fn=listen) as job:
        while not mark.exists():
            time.sleep(0.1)
        job.send_signal(ending)
        assert job.wait(20.0) == 128 + ending
    assert gone(int(mark.read_text()))
    assert report(tmp_path / "out")["stages"]["sanitizer"]["state"] == "begun"


def gone(pid: int) -> bool:
    """Tell whether a process ends in ten seconds: an ended one has its number until its new parent hears of it."""
    until = time.monotonic() + 10.0
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_a_command_runs_next_to_others(tmp_path):
    beside = Command([sys.executable, "-c", "print('compiled')"], tmp_path / "log", {"A": "b"})
    found = run([sys.executable, "-c", "print('measured')"], 30.0, tmp_path / "other")
    assert (found["status"], found["output"]) == (0, "measured\n")
    assert beside.wait(30.0)["output"] == "compiled\n"


def test_a_commit_is_known_without_git(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_check, "ROOT", tmp_path)
    monkeypatch.delenv(gpu_check.COMMIT, raising=False)
    assert commit_of(None) == commit_of(tmp_path) == "unknown"
    write_json(tmp_path / "manifest.json", {"commit": "c0ffee"})
    assert commit_of(tmp_path) == "c0ffee"
    monkeypatch.setenv(gpu_check.COMMIT, "beef")
    assert commit_of(tmp_path) == "beef"
    # what a failing command says is no answer
    monkeypatch.setattr(gpu_check_tools, "ROOT", tmp_path)
    assert first_line(["git", "-C", str(tmp_path), "rev-parse", "HEAD"]) is None
    assert first_line(["no-such-command"]) is None
    assert first_line(["printf", "one\ntwo\n"]) == "one"
    monkeypatch.setattr(gpu_check_tools, "QUERY_LIMIT_S", 0.1)
    assert first_line(["sleep", "60"]) is None  # a driver that hangs


@pytest.mark.slow
def test_a_training_is_reported_with_its_loading_apart(tmp_path):
    assert pop(["demo", str(tmp_path / "toy"), "--views", "8", "--width", "40", "--height", "32"]) == 0
    one = train_one(check(tmp_path, steps_scaler=0.001), tmp_path / "toy", 120.0, backend="fast")
    assert one["status"] == 0, one["output"]
    assert one["step"] == 29
    assert one["psnr"] > 5.0
    assert 0.0 < one["ssim"] < 1.0
    assert one["num_GS"] > 0
    assert 0.0 < one["seconds_training"] < one["seconds"]
    assert one["seconds_loading"] > 0.0


def test_a_training_that_cannot_be_says_why_and_the_next_is_begun(tmp_path):
    notes: list[dict[str, object]] = []
    missing = (tmp_path / "a", tmp_path / "b")
    shared = check(tmp_path, captures=missing, note=lambda told: notes.append(json.loads(json.dumps(told))))
    found = gpu_check_stages.train_stage(shared)
    assert found["status"] != 0
    assert [list(note["runs"]) for note in notes] == [["a"], ["a", "b"]]  # type: ignore[call-overload]
    assert all("pop: error: " in one["output"] for one in found["runs"].values())
    assert "no captures" in gpu_check_stages.train_stage(check(tmp_path))["skipped"]


@pytest.mark.parametrize("apart", [6999, 29999])
def test_ranks_are_compared_by_the_gaussians_after_the_last_step(tmp_path, monkeypatch, apart):
    def trained(check, path, folder, limit, words, size):
        (folder / "ply").mkdir(parents=True)
        for step in (6999, 29999):
            (folder / "ply" / f"point_cloud_{step}.ply").write_text(f"{step} of {size if step == apart else 'any'}")
        return {"status": 0, "seconds": 1.0}

    monkeypatch.setattr(gpu_check_stages, "_train", trained)
    monkeypatch.setattr(gpu_check_stages, "count_gpus", lambda check: 2)
    found = gpu_check_stages.ranks_stage(check(tmp_path, captures=(tmp_path / "scene",)))
    assert (found["same_bits"], found["status"]) == ((False, 1) if apart == 29999 else (True, 0))


@pytest.mark.parametrize(("gpus", "sizes"), [(2, "1 2"), (3, "1 3"), (4, "1 2 4"), (6, "1 2 6"), (8, "1 2 4 8")])
def test_any_number_of_gpus_has_bits_to_compare(tmp_path, monkeypatch, gpus, sizes):
    monkeypatch.setattr(gpu_check_stages, "_train", lambda *_: {"status": 0, "seconds": 1.0})
    monkeypatch.setattr(gpu_check_stages, "count_gpus", lambda check: gpus)
    found = gpu_check_stages.ranks_stage(check(tmp_path, captures=(tmp_path / "scene",)))
    assert " ".join(found["runs"]) == sizes


@pytest.mark.parametrize("finished", [False, True])
def test_captures_that_are_given_stand_for_those_that_were_not_packed(tmp_path, monkeypatch, finished):
    (tmp_path / "packed").mkdir()
    brought = {"packed": tmp_path / "packed"}
    assert "no captures" in gpu_check_stages.reproduce_stage(check(tmp_path, **brought))["skipped"]
    asked = []

    def stopped(self, words, limit):
        asked.extend(words)
        if finished:
            write_json(tmp_path / "work" / "paper_repro" / "results" / "small" / "pop.jsonl", {})
        return {"status": 130, "seconds": 1.0, "output": "stopped"}

    monkeypatch.setattr(StageContext, "run", stopped)
    found = gpu_check_stages.reproduce_stage(check(tmp_path, **brought, captures=(tmp_path / "data" / "fox",)))
    assert asked[asked.index("--data") + 1] == str(tmp_path / "data")
    # the time ends every call; one that has nothing to show for it is no pass
    assert (found["status"], len(found["rows"])) == ((0, 1) if finished else (124, 0))
    assert "the time was up" in found["note"]


@pytest.mark.parametrize("kinds", [0, 1, 3])
def test_a_sanitizer_that_supports_no_device_is_skipped_and_has_not_passed(tmp_path, monkeypatch, kinds):
    said = iter([{"status": 9, "seconds": 1.0, "output": "Error: Device not supported"}] * kinds)
    passed = {"status": 0, "seconds": 1.0, "output": ""}
    monkeypatch.setattr(gpu_check_stages, "_pytest", lambda *_, **__: next(said, passed))
    monkeypatch.setattr(gpu_check_stages.shutil, "which", lambda name: name)
    found = gpu_check_stages.sanitizer_stage(check(tmp_path))
    assert (found["status"], "skipped" in found) == (0, kinds == 3)


def test_a_training_without_the_package_of_the_command_line_is_skipped(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_check_stages.importlib.util, "find_spec", lambda name: None)
    found = gpu_check_stages.train_stage(check(tmp_path, captures=(tmp_path,)))
    assert (found["status"], "needs tyro" in found["skipped"]) == (0, True)


@pytest.mark.slow
def test_rows_of_the_paper_are_trained_and_brought_back(tmp_path, monkeypatch):
    assert "no captures" in gpu_check_stages.reproduce_stage(check(tmp_path))["skipped"]
    monkeypatch.setattr(gpu_check_stages, "REPRODUCED", ("l1_div_100",))
    found = gpu_check_stages.reproduce_stage(
        check(tmp_path, captures=(tmp_path / "demo",), rehearsal=True, seconds=600.0)
    )
    assert found["status"] == 0, found["output"]
    assert found["rows"] == ["toy/l1_div_100.jsonl"]
    (line,) = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert from_line(line, "the row").row == "l1_div_100"


def test_gsplat_that_was_not_compiled_is_told_and_is_no_failure(tmp_path):
    assert "not among the wheels" in gpu_check_stages.gsplat_stage(check(tmp_path))["skipped"]
    command = [sys.executable, "-c", "raise SystemExit('nvcc does not know this')"]
    failing = Command(command, tmp_path / "compilation.log")
    found = gpu_check_stages.gsplat_stage(check(tmp_path, beside={"gsplat": failing}))
    assert (found["status"], "was not compiled" in found["skipped"]) == (0, True)
    assert "nvcc does not know this" in found["compilation"]["output"]


OLD = '{"old": {"status": 0}}'


@pytest.mark.parametrize(
    ("stages_before", "changed", "kept"),
    [
        *(("[]", {}, False), ('"x"', {}, False), ("null", {}, False), (OLD, {}, True)),
        # what the emulator, another commit or another card came to is none of this call's
        (OLD, {"rehearsal": True}, False),
        (OLD, {"environment": {"commit": "beef"}}, False),
    ],
)
def test_a_report_of_an_earlier_call_is_gone_on_with_or_begun_anew(
    stages, tmp_path, monkeypatch, stages_before, changed, kept
):
    monkeypatch.setenv(gpu_check.COMMIT, "c0ffee")
    before = {"job": 1, "rehearsal": False, "environment": {"commit": "c0ffee"}, "stages": json.loads(stages_before)}
    (tmp_path / "gpu_check_1.json").write_text(json.dumps(before | changed))
    stages["laws"] = lambda check: {"status": 0, "seconds": 1.0}
    assert main([str(tmp_path), "--stages", "laws"]) == 0
    found = report(tmp_path)["stages"]
    assert found["laws"]["status"] == 0
    assert ("old" in found) == kept


def test_counters_of_an_earlier_call_are_not_those_of_one_that_fails(tmp_path, monkeypatch):
    write_json(tmp_path / "gpu_counters.json", {"kernels": ["old"]})
    monkeypatch.setattr(gpu_check_stages.shutil, "which", lambda name: name)
    monkeypatch.setattr(StageContext, "run", lambda *_: {"status": 1, "seconds": 1.0, "output": "ncu failed"})
    assert gpu_check_stages.counters_stage(check(tmp_path))["results"] == {}


def test_a_node_without_git_tells_its_commands_the_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_check_tools, "run", lambda words, limit, log, environment, stop: environment)
    monkeypatch.setattr(gpu_check_tools, "ROOT", tmp_path)
    assert check(tmp_path).run([], 1.0)["POP_COMMIT"] == "c0ffee"
    assert "POP_COMMIT" not in check(tmp_path, commit="unknown").run([], 1.0)
    # git also knows of changes
    (tmp_path / ".git").mkdir()
    assert "POP_COMMIT" not in check(tmp_path).run([], 1.0)


def test_a_damaged_wheel_costs_no_other(tmp_path):
    wheels = tmp_path / "packed" / "wheels"
    wheels.mkdir(parents=True)
    sound = stand_in_gsplat(wheels)
    (wheels / "broken-1.0-py3-none-any.whl").write_bytes(sound.read_bytes()[:200])
    found = wheels_stage(check(tmp_path, packed=tmp_path / "packed"))
    assert found["status"] != 0
    assert found["wheels"] == ["gsplat-0.0"]
    assert list(found["damaged"]) == ["broken-1.0"]
    assert "broken-1.0-py3-none-any.whl" in found["output"]
    assert (tmp_path / "work" / "site" / "gsplat" / "__init__.py").is_file()


@pytest.mark.parametrize("damage", [b'{"test": "a", "outc', b"[1]", b"\xff", b'{"test": 1}', b"[" * 100_000])
def test_a_damaged_line_of_outcomes_is_counted_and_left_out(tmp_path, damage):
    line = json.dumps({"test": "a", "outcome": "passed", "seconds": 0.5, "words": ""})
    (tmp_path / "x.jsonl").write_bytes(line.encode() + b"\n" + damage)
    found = outcomes(tmp_path / "x.jsonl")
    assert (found["passed"], found["damaged"]) == (1, 1)


def test_outcomes_are_those_of_the_tests(tmp_path, monkeypatch):
    """Every test is written down when it ends, a file that cannot be imported too; nothing but skips is no pass."""
    (tmp_path / "tests" / "cuda" / "gpu").mkdir(parents=True)
    monkeypatch.setattr(gpu_check_stages, "ROOT", tmp_path)
    text = "import pytest\ndef test_a(): pass\ndef test_b(): assert 1 == 2\n@pytest.mark.skip(reason='no GPU')\n"
    (tmp_path / "tests" / "cuda" / "gpu" / "test_x.py").write_text(text + "def test_c(): pass\n")
    (tmp_path / "tests" / "cuda" / "gpu" / "test_y.py").write_text("import nothing_of_that_name\n")
    root = str(gpu_check_tools.ROOT)
    monkeypatch.setenv("PYTHONPATH", root)
    found = gpu_check_stages._pytest(check(tmp_path), "laws", ("test_x.py",))
    assert found["status"] == 1
    told = found["tests"]
    assert [told[name] for name in ("passed", "failed", "skipped")] == [1, 1, 1]
    assert told["failures"][0]["test"].endswith("::test_b")
    assert "assert 1 == 2" in told["failures"][0]["words"]
    assert "no GPU" in str(told["skipped_for"])
    found = gpu_check_stages._pytest(check(tmp_path), "laws", ("test_x.py",), "-k", "test_c")
    assert (found["status"], found["tests"]["passed"]) == (1, 0)
    found = gpu_check_stages._pytest(check(tmp_path), "laws", ("test_y.py",))
    assert "nothing_of_that_name" in found["tests"]["failures"][0]["words"]
    assert outcomes(tmp_path / "absent.jsonl")["passed"] == 0


def test_a_file_is_written_whole(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"k": 1})
    with pytest.raises(TypeError):
        write_json(tmp_path / "a.json", {"k": object()})
    assert json.loads((tmp_path / "a.json").read_text()) == {"k": 1}


def test_the_whole_call_ends_before_its_limit(stages, tmp_path):
    """A stage that never ends is cut off, and the file is complete with the stages after it."""
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"
    stages["bench"] = lambda check: check.run([sys.executable, "-c", deaf], check.seconds)
    stages["gsplat"] = lambda check: {"status": 0, "seconds": check.seconds}
    start = time.monotonic()
    assert main([str(tmp_path), "--limit-s", "18", "--stages", "bench", "gsplat"]) == 1
    assert time.monotonic() - start < 18.0
    found = report(tmp_path)
    assert found["complete"]
    assert found["stages"]["bench"]["status"] == 124
    assert found["stages"]["gsplat"]["seconds"] > 3.0


def test_every_test_that_needs_a_gpu_is_run_by_a_stage() -> None:
    there = {file.name for file in (gpu_check_tools.ROOT / "tests" / "cuda" / "gpu").glob("test_*.py")}
    assert {*gpu_check_stages.LAWS, *gpu_check_stages.STEPS} == there
    assert {test.partition("::")[0] for test in gpu_check_stages.SMOKE} <= there


# What travels to a bare node: every file listed, under the limit, and what cannot be packed told.

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def pack(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import gpu_pack

    def packed(folder: Path, *words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["gpu_pack", str(folder), "--no-wheels", *words])
        return gpu_pack.main()

    packed.module = gpu_pack
    return packed


def test_a_packed_capture_is_the_capture_shrunk(pack, tmp_path):
    source = colmap_capture(tmp_path / "scene")
    assert pack(tmp_path / "pack", "--captures", str(source), "--pixels", "200") == 0
    before, after = (load_capture(path, normalize=False) for path in (source, tmp_path / "pack" / "captures" / "scene"))
    assert len(after.views) == len(before.views)
    np.testing.assert_allclose(after.points, before.points, rtol=1e-5)
    assert np.array_equal(after.points_rgb, before.points_rgb)
    for ours, theirs in zip(after.views, before.views, strict=True):
        assert ours.width * ours.height < 230 < theirs.width * theirs.height
        np.testing.assert_allclose(ours.viewmat, theirs.viewmat, atol=1e-12)
        # what a pixel of the photograph sees, one of the shrunk one sees too
        np.testing.assert_allclose(ours.K[0] / ours.width, theirs.K[0] / theirs.width, rtol=1e-12)
        np.testing.assert_allclose(ours.K[1] / ours.height, theirs.K[1] / theirs.height, rtol=1e-12)
        assert abs(float(ours.image.mean()) - float(theirs.image.mean())) < 8.0


def test_a_capture_packed_whole_keeps_its_bytes(pack, tmp_path):
    source = colmap_capture(tmp_path / "scene")
    assert pack(tmp_path / "pack", "--whole", str(source), "--pixels", "200") == 0
    kept = tmp_path / "pack" / "captures" / "scene"
    files = sorted(path.relative_to(source) for path in source.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(kept) for path in kept.rglob("*") if path.is_file())
    assert all((source / path).read_bytes() == (kept / path).read_bytes() for path in files)


def test_every_file_is_listed_with_its_digest(pack, tmp_path):
    folder = tmp_path / "pack"
    assert pack(folder, "--captures", str(colmap_capture(tmp_path / "scene"))) == 0
    manifest = json.loads((folder / "manifest.json").read_text())
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json"]
    assert sorted(manifest["files"]) == sorted(path.relative_to(folder).as_posix() for path in files)
    for path in files:
        entry = manifest["files"][path.relative_to(folder).as_posix()]
        assert entry == {"bytes": path.stat().st_size, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert manifest["packed_bytes"] == sum(path.stat().st_size for path in files)
    assert manifest["repository_bytes"] > 1_000_000


def test_what_cannot_be_packed_is_told_and_the_rest_is_packed(pack, tmp_path, capsys):
    folder = tmp_path / "pack"
    words = ["--runs", str(tmp_path / "nothing"), "--captures", str(colmap_capture(tmp_path / "scene"))]
    assert pack(folder, *words) == 1
    told = json.loads((folder / "manifest.json").read_text())["absent"]
    assert len(told) == 1
    assert "nothing" in told[0]
    assert told[0] in capsys.readouterr().err
    assert (folder / "captures" / "scene" / "images" / "0001.jpg").is_file()


def test_a_pack_that_is_too_large_is_refused_and_no_other_folder_touched(pack, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pack.module, "LIMIT", 1000)
    assert pack(tmp_path / "pack") == 1
    assert "too much to travel" in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    assert pack(tmp_path / "mine") == 2
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years"
    assert "holds files that no pack has" in capsys.readouterr().err


def test_two_sources_of_one_name_are_not_mixed(pack, tmp_path, capsys):
    source = colmap_capture(tmp_path / "scene")
    other = shutil.copytree(source, tmp_path / "other" / "scene")
    assert pack(tmp_path / "pack", "--captures", str(source), str(other), "--whole", str(other)) == 1
    assert capsys.readouterr().err.count("another scene is packed already; rename one of the two") == 2
    assert len(json.loads((tmp_path / "pack" / "manifest.json").read_text())["absent"]) == 2


def test_a_pack_that_was_interrupted_is_begun_anew(pack, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    words = [tmp_path / "pack", "--captures", str(colmap_capture(tmp_path / "scene"))]
    with monkeypatch.context() as context:
        context.setattr(pack.module, "_points", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pack(*words)
    assert pack(*words) == 0


def test_a_pack_that_cannot_be_is_refused_by_name(pack, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "x"):
        assert pack(folder) == 2
        assert f"gpu_pack: {folder}: Not a directory; name another folder" in capsys.readouterr().err
    for pixels in ("0", "nan", "-5"):
        assert pack(tmp_path / "pack", "--pixels", pixels) == 2
        assert f"--pixels is {pixels}; it must be at least 1" in capsys.readouterr().err
    assert not (tmp_path / "pack").exists()
