"""The command line as a user meets it: help, aliases, exit statuses, and a whole run from nothing.

Bad captures and settings end with status 2 and one line that names file, field and fix. There is one of each kind here:
`test_captures`, `test_transforms`, `test_config` and `test_damaged_results` have what is said of all others.
"""

from __future__ import annotations

import errno
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import pop_fast
from cuda_ext.build import BuildError
from paper_repro.cli import COMMANDS as REPRO_COMMANDS
from pop_fast.children import module_command, python_command
from pop_fast.cli import COMMANDS, describe, main, message, printable
from pop_fast.cli.completion import bash, fish, options_of
from pop_fast.cli.train import arguments, rename_aliases
from pop_fast.cli.train_options import about_large, takes_hours
from pop_fast.data.capture import Capture, View
from pop_fast.data.sfm import SfmResult
from pop_fast.errors import PopError
from pop_fast.stages.tiles import tile_lists
from pop_fast.train import TrainConfig, choose
from tests.app.captures import edit_transforms, photograph, transforms_capture, write_photograph
from tests.app.conftest import ROOT, TRAIN, Outcome, Pop, in_a_child
from tests.app.damage import contents, says
from tests.app.tiny import interrupt


def test_the_overview_lists_every_subcommand_without_importing_torch() -> None:
    code = "import sys, pop_fast.cli as c; c.main(['--help']); sys.exit({'torch', 'numpy'} & {*sys.modules} != set())"
    outcome = in_a_child(code)
    assert outcome.status == 0, outcome.err
    for name, summary in COMMANDS.items():
        assert f"{name} " in outcome.out
        assert summary in outcome.out


_LEAVING = """
import atexit, os, signal, sys
from pathlib import Path
from pop_fast.cli import guarded

def run(words):
    for _ in range(2):
        print("told", flush=True)
        print("told", file=sys.stderr)
    with open(words[1], "wb") as file:
        os.write(2, b"what a library says")
    Path(words[2].partition("=")[2]).touch()
    atexit.register(os.kill, os.getpid(), signal.SIGINT)
    return int(words[0])

sys.exit(guarded("pop", run, None, "interrupted"))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX pipes")
@pytest.mark.parametrize("streams", ["whose reader has gone", "closed", "that are read"])
@pytest.mark.parametrize("status", [0, 2, 130])
def test_work_goes_on_to_its_own_status_whoever_reads_what_it_prints(tmp_path, streams, status):
    words = ["env", f"HOME={tmp_path}", sys.executable, "-c", _LEAVING, str(status), f"{tmp_path}/file", "--out=~/mine"]
    reader, writer = os.pipe()
    os.close(reader)
    gone, read = {"stdout": writer, "stderr": writer}, {"capture_output": True, "text": True}
    how = {"whose reader has gone": gone, "that are read": read}.get(streams, {})
    # as in `pop train >&- 2>&-`
    shell = ["sh", "-c", '"$@" >&- 2>&-', "sh"] if streams == "closed" else []
    done = subprocess.run([*shell, *words], **how, cwd=ROOT, check=False)
    os.close(writer)
    assert done.returncode == status
    # Ctrl-C comes too late
    assert done.stderr in (None, "told\ntold\nwhat a library says")
    assert (tmp_path / "file").read_bytes() == b""
    # `~` after an equals sign, too, is the user's folder
    assert (tmp_path / "mine").exists()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_subcommand_explains_itself(pop: Pop, name: str) -> None:
    outcome = pop.done(*name.split(), "--help")
    assert outcome.out.startswith(f"usage: pop {name}")
    assert "Attributes:" not in outcome.out
    assert pop.done("help", *name.split()).out == outcome.out


@pytest.mark.parametrize("name", ["train", "eval", "render", "view", "explain", "export", "compare", "convert", "sfm"])
def test_no_line_of_help_breaks_off_where_the_window_has_room(pop, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "1500")
    about = re.findall(r"^│? {6,}(\S.*?) *│?$", pop.done(name, "--help").out, re.MULTILINE)
    assert about
    assert [line for line in about if not line.endswith((")", "exit"))] == []


def test_help_shows_what_matters_first_and_help_all_all(pop: Pop) -> None:
    assert pop().out.startswith("usage: pop COMMAND")
    assert pop("help").out == pop().out
    assert pop("--version").out.startswith("pop 0.")
    shown = pop("train", "--help").out
    assert "--pop.theta-blur" not in shown
    # what a run chooses for itself has no other default
    whole = [
        " ".join(line.strip("│ \n") for line in text.splitlines())
        for text in (shown, pop("train", "--help", "--preset", "quick").out)
    ]
    assert [text.count("(default: chosen)") for text in whole] == [3, 0]
    assert ["training steps, of `batch_size` views each. (default: chosen)" in text for text in whole] == [True, False]
    assert "--pop.theta-blur" in pop("train", "--help_all").out
    # it begins with what is trained and ends with blocks
    names = ("method {", "factor INT", "resume,", "export [", "crop {", "blocks {")
    places = [shown.index(f"--{name}") for name in names]
    assert places == sorted(places)


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        ("trian x", "did you mean 'pop train'?"),
        ("data chek", "did you mean 'pop data check'?"),
        ("docter", "did you mean 'pop doctor'?"),
        ("qqqq", "see 'pop --help'"),
        ("train", ""),
        ("train x --no-such-option", ""),
    ],
)
def test_bad_usage_has_status_two_and_an_unknown_subcommand_suggests_the_nearest(pop, words, hint):
    outcome = pop(*words.split())
    assert outcome.status == 2
    assert hint in outcome.err
    assert outcome.err.startswith("pop: error: ") or not hint


@pytest.mark.parametrize(
    "words",
    [
        "scene --out r",
        "-s scene -m r",
        "--source_path scene --model_path r --eval",
        "--source_path=scene --model_path=r",
        "--data_dir scene --result_dir r",
    ],
)
def test_habits_of_other_trainers_are_understood(words: str) -> None:
    config, _ = arguments(words.split())
    assert (config.data, config.result_dir) == ("scene", "r")
    # values are never taken for aliases, and without a folder it is named after data and method
    assert rename_aliases(["a", "--images", "my_photos"]) == ["a", "--images", "my_photos"]
    assert arguments(["captures/garden/", "--method", "gsplat"])[0].result_dir == "out/garden_gsplat"


STATS = "stats/val_step0029.json"


def test_a_bare_folder_of_photographs_is_placed_then_trained_on_and_the_end_is_told(
    pop, capture, tmp_path, monkeypatch
):
    (capture / "sparse").rename(tmp_path / "sparse")

    def placed(photos: Path, root: Path, **_: Any) -> SfmResult:
        assert photos == capture / "images"
        (tmp_path / "sparse").rename(root / "sparse")
        return SfmResult(root, 8, 8, 100, 0.5)

    monkeypatch.setattr("pop_fast.data.load.run_sfm", placed)
    outcome = pop.done("train", capture, "--out", tmp_path / "r", *TRAIN)
    assert "toy: COLMAP model: 8 views" in outcome.out
    assert "PSNR" in outcome.out
    assert f"report: {tmp_path / 'r' / 'report.html'}" in outcome.out


def test_ctrl_c_says_how_to_go_on_and_exits_with_130(pop, shared_capture, tmp_path, monkeypatch):
    for at, said in (
        (10, "stopped after step 10; the same command with --resume continues from step 7"),
        (0, "stopped before the first step; nothing was written"),
    ):
        interrupt(monkeypatch, at=at)
        outcome = pop("train", shared_capture, "--out", tmp_path / str(at), *TRAIN)
        assert (outcome.status, outcome.err.strip()) == (130, f"pop: {said}")
    assert not (tmp_path / "0").exists()


def test_eval_repeats_the_numbers_of_training(pop, shared_result, shared_capture, tmp_path):
    written = tmp_path / "e.json"
    outcome = pop.done("eval", shared_result / "ckpts" / "ckpt_29_rank0.pt", "--json", written, "--per-view")
    trained, measured = (json.loads(path.read_text()) for path in (shared_result / STATS, written))
    for key in ("psnr", "ssim", "num_GS", "n_blended", "n_traversed", "per_view"):
        assert measured[key] == trained[key], key
    page = (ROOT / "docs" / "using.md").read_text(encoding="utf-8").partition("**For programs.**")[2]
    named = set(re.findall(r"`([a-z]\w+[_.\w]*)`", page.partition("The files in")[0]))
    assert named == {key for key in measured if not key.startswith("lpips_")}
    assert f"PSNR       {trained['psnr']:.3f} dB" in outcome.out
    assert "view_000.png: psnr" in outcome.out
    # a PLY needs a capture, and agrees with the checkpoint
    ply = tmp_path / "lone.ply"
    ply.write_bytes((shared_result / "ply" / "point_cloud_29.ply").read_bytes())
    says(pop("eval", ply), "give --capture DIR")
    pop.done("eval", ply, "--capture", shared_capture, "--json", written)
    assert json.loads(written.read_text())["psnr"] == pytest.approx(trained["psnr"], abs=1e-3)


@pytest.mark.parametrize("name", ["ckpts/ckpt_29_rank0.pt", "ply/point_cloud_29.ply", "cfg.json"])
def test_numbers_and_pages_never_replace_what_they_are_of(pop: Pop, result: Path, name: str) -> None:
    kept = (result / name).read_bytes()
    lone = [result / name] if name != "cfg.json" else []
    for splat in (result, *lone):
        for words in (("eval", splat, "--json"), ("explain", splat, "--view", 0, "--pixel", "3,3", "--html")):
            says(pop(*words, result / name), f"{result / name}: is read by this command, so it is not replaced")
    assert (result / name).read_bytes() == kept


def test_a_run_that_holds_out_no_view_has_no_numbers_of_any(pop: Pop, capture: Path, tmp_path: Path) -> None:
    words = ("train", capture, "--out", tmp_path / "run", "--max-steps", "2", "--test-every", "0", "--skip-checks")
    head = next(line for line in pop.done(*words).out.splitlines() if line.startswith("format"))
    assert head.split() == ["format", "MB", "B/Gaussian", "of", "the", "PLY"]
    assert "0.0 / 0.0" not in pop.done("compare", tmp_path / "run").out
    assert "0.0 traversed" not in (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    says(pop("eval", tmp_path / "run"), "no view is held out")


def test_eval_of_a_result_updates_its_stats_and_report(pop: Pop, result: Path) -> None:
    before = json.loads((result / STATS).read_text())
    (result / STATS).write_text(json.dumps({**before, "psnr": 1.0}))
    (result / "report.html").unlink()
    for other in (("--factor", "2"), ("--test-every", "2"), ("--own-frame",)):
        pop.done("eval", result, *other)
        assert json.loads((result / STATS).read_text())["psnr"] == 1.0
    pop.done("eval", result)
    after = json.loads((result / STATS).read_text())
    assert (after["psnr"], after["seconds"]) == (before["psnr"], before["seconds"])
    assert (result / "report.html").is_file()


def test_eval_measures_a_result_that_may_not_be_written_to(pop: Pop, result: Path, monkeypatch) -> None:
    before = contents(result)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "stats")
    outcome = pop.done("eval", result)
    assert "PSNR" in outcome.out
    assert f"note: {result / 'stats'} may not be written to" in outcome.err
    assert contents(result) == before


def test_the_size_of_photographs_is_told_where_it_is_asked_for_by_another_name(pop: Pop) -> None:
    for option in ("--max-size", "-r", "--resolution"):
        says(pop("train", "photos", option, "1600"), option, "--factor 2")


def test_photographs_of_full_size_are_told_what_they_cost() -> None:
    image = np.broadcast_to(np.zeros(3, np.uint8), (3000, 4000, 3))
    view = View("a.jpg", image, np.eye(4), np.eye(3))
    large = Capture("large", (view, replace(view, name="b.jpg")), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), "")
    told = about_large(large, TrainConfig())
    assert "4000x3000 px" in told
    assert "--factor 3 takes about 1/9 of the time, at 1333x1000 px" in told
    small = replace(view, image=image[:1000, :1333])
    assert about_large(replace(large, views=(small, replace(small, name="b.jpg"))), TrainConfig()) is None


def test_compare_puts_results_side_by_side(pop: Pop, shared_result: Path) -> None:
    plain = pop.done("compare", shared_result, shared_result)
    assert len(plain.out.splitlines()) == 3
    assert pop("compare", shared_result, "--markdown").out.splitlines()[1].startswith("| --- | --- | ---: |")


def test_a_file_is_measured_by_the_photographs_that_the_results_beside_it_were_trained_on(pop, capture, tmp_path):
    run, lone, folder = tmp_path / "run", tmp_path / "lone.ply", tmp_path / "folder"
    (capture / "images").rename(capture / "shots")
    how = ("--images", "shots", "--factor", "2", "--background", "1", "1", "1")
    pop.done("train", capture, "--out", run, *how, "--max-steps", "2", "--skip-checks", "--skip-sizes")
    pop.done("export", run, "--out", lone)
    pop.done("export", run, "--out", tmp_path / "lone.sog")
    with zipfile.ZipFile(tmp_path / "lone.sog") as archive:
        archive.extractall(folder)

    def psnr(*words: str) -> list[str]:
        table = pop.done("compare", run, lone, "--markdown", *words).out.splitlines()
        at = table[0].split("|").index(" PSNR ")
        return [line.split("|")[at] for line in table[2:]]

    beside, asked, whole = psnr(), psnr("--factor", "2"), psnr("--factor", "1")
    assert beside == asked
    assert beside[0] == beside[1]
    assert whole[0] != whole[1]
    assert psnr("--capture", str(capture)) == beside
    assert psnr("--capture", str(capture), "--test-every", "2") != beside
    # SOG in a folder is the file of a splat too
    assert "  folder  " in pop.done("compare", run, folder).out


def test_sfm_says_how_well_it_went(pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = SfmResult(tmp_path / "scene", 7, 8, 1234, 0.75)
    monkeypatch.setattr("pop_fast.data.sfm.run_sfm", lambda *_, **__: found)
    said = pop.done("sfm", tmp_path).out
    assert "7 of 8 photographs placed, 1,234 points, mean reprojection error 0.75 px" in said


def raising(error: BaseException) -> Callable[..., Any]:
    def call(*_: Any, **__: Any) -> None:
        raise error

    return call


def test_building_cuda_says_what_is_missing_first_and_the_compiler_s_words_apart(pop, monkeypatch):
    error = BuildError("compiling the CUDA extension failed; nvcc said:\nerror: expected a ;")
    monkeypatch.setattr("pop_fast.cli.build.build_cuda", raising(error))
    outcome = pop("build-cuda")
    assert outcome.status == 2
    assert outcome.err.strip() == "pop: error: compiling the CUDA extension failed; nvcc said:"
    assert outcome.out == "error: expected a ;\n"


def test_a_fault_of_the_program_keeps_its_traceback_and_ctrl_c_anywhere_exits_with_130(pop, monkeypatch):
    monkeypatch.setattr("pop_fast.view.report.source.write_report", raising(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        pop("report", ".")
    monkeypatch.setattr("pop_fast.view.report.source.write_report", raising(KeyboardInterrupt()))
    outcome = pop("report", ".")
    assert (outcome.status, outcome.err.strip()) == (130, "pop: interrupted")


@pytest.mark.parametrize("program", ["pop", "pop-repro"])
def test_ctrl_c_while_a_program_is_loaded_shows_no_traceback(program: str) -> None:
    at = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"][program].replace(":", " import ")
    script = f"""
import sys
class Interrupt:
    def find_spec(self, name, *_):
        if name == "difflib":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupt())
from {at} as start
sys.exit(start())"""
    assert in_a_child(script) == Outcome(130, "", f"{program}: interrupted\n")


@pytest.mark.parametrize(
    ("fault", "status", "words"),
    [
        (OSError(28, "No space left on device", "report.html"), 1, "report.html: the disk is full"),
        (ZeroDivisionError("a bug"), 1, "ZeroDivisionError: a bug"),
        (KeyboardInterrupt(), 130, "stopped while writing the report"),
    ],
    ids=repr,
)
def test_results_are_complete_before_the_report_and_whatever_becomes_of_it(
    pop, shared_capture, tmp_path, fault, status, words
):
    folder, found = tmp_path / "r", []

    def broken(result: Path) -> None:
        found.extend(sorted(path.relative_to(result).as_posix() for path in Path(result).rglob("*") if path.is_file()))
        raise fault

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pop_fast.view.report.source.write_report", broken)
        outcome = pop("train", shared_capture, "--out", folder, *TRAIN)
    assert {"ckpts/ckpt_29_rank0.pt", "ply/point_cloud_29.ply", STATS, "cfg.json"} <= set(found)
    assert outcome.status == status
    assert "PSNR" in outcome.out
    (line,) = [line for line in outcome.err.splitlines() if line.startswith("pop: ")]
    assert words in line
    assert f"the results in {folder} are complete; pop report {folder} writes the report" in line
    assert not (folder / "report.html").exists()
    pop.done("report", folder)
    pop.done("eval", folder)


def test_a_reader_that_stops_listening_is_no_error() -> None:
    command = f"{sys.executable} -c 'import pop_fast.cli as c, sys; sys.exit(c.main([\"--help\"]))' | true"
    done = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr


def test_debug_shows_the_traceback_of_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PopError):
        main(["report", "nowhere", "--debug"])
    monkeypatch.setenv("POP_DEBUG", "1")
    with pytest.raises(PopError):
        main(["report", "nowhere"])


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "x", "a.png"), "a.png: the disk is full"),
        (PermissionError(errno.EACCES, "x", "a.png"), "a.png: permission denied"),
        (FileNotFoundError(errno.ENOENT, "x", "a.png"), "a.png: no such file or folder"),
        (FileNotFoundError(errno.ENOENT, "No usable temporary directory"), "No usable temporary directory; let TMPDIR"),
        (IsADirectoryError(errno.EISDIR, "x", "a"), "a: is a folder where a file is needed"),
        (FileExistsError(errno.EEXIST, "x", "a"), "a: a file is in the way"),
        (OSError(errno.EIO, "input/output error", "a"), "a: input/output error"),
        (MemoryError(), "out of memory; use smaller images"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: 9 bytes"), "out of memory"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "out of memory"),
        (PopError("two\nlines"), "two lines"),
        (ValueError("from a library below"), None),
        (OSError("no number"), None),
    ],
)
def test_errors_of_the_system_are_one_line_each(error: Exception, line: str | None) -> None:
    said = describe(error)
    assert (said is None) == (line is None)
    assert line is None or str(said).startswith(line)
    assert "\n" not in str(said)


# What people type, and how they call their files: none of it is taken for something else or reaches a terminal raw.


@pytest.mark.parametrize("name", ["a=b", "x y", "--", "-s"])
def test_a_path_may_hold_an_equals_sign_or_a_space(pop: Pop, shared_capture: Path, tmp_path: Path, name: str) -> None:
    data = Path(shutil.copytree(shared_capture, tmp_path / name / "data=1"))
    pop.done("train", data, "--out", tmp_path / f"{name} out=1", *TRAIN, "--max-steps", "2")
    assert (tmp_path / f"{name} out=1" / "cfg.json").is_file()


def test_iterations_are_steps() -> None:
    assert arguments(["scene", "--iterations", "700"])[0].max_steps == 700
    assert arguments(["scene", "--preset", "quick", "--iterations=700"])[0].max_steps == 700


@pytest.mark.slow  # it trains
def test_a_photograph_whose_name_is_no_text_is_trained_on(pop: Pop, tmp_path: Path) -> None:
    # a file name is bytes; Python carries the odd ones through a string
    odd = os.fsdecode(b"view\xff.png")
    root = transforms_capture(tmp_path / "scene", 9)
    (root / "images" / "04.png").rename(root / "images" / odd)
    edit_transforms(root, lambda listing: listing["frames"][4].update(file_path=f"images/{odd}"))
    words = ("train", root, "--out", tmp_path / "r", *TRAIN, "--max-steps", "3", "--test-every", "2")
    pop.done(*words)
    assert (tmp_path / "r" / "report.html").is_file()
    assert "view" in (tmp_path / "r" / "stats" / "val_step0002.json").read_text()
    pop.done(*words, "--resume")


def test_escape_sequences_in_names_are_shown_and_not_obeyed(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    evil = tmp_path / "a\x1b[31m\r\u202eb"
    says(pop("eval", evil), r"a\x1b[31m", r"\u202eb")
    shutil.copytree(shared_capture, evil)
    outcome = pop.done("train", evil, "--out", tmp_path / "r", *TRAIN, "--max-steps", "2")
    assert "\x1b" not in outcome.out + outcome.err
    assert r"a\x1b[31m" in outcome.out
    assert "\x1b" not in pop("data", "check", evil).out
    for words in (("compare", tmp_path / "r"), ("render", tmp_path / "r", "--out", tmp_path / "v")):
        assert r"a\x1b[31m" in pop.done(*words).out


def test_messages_keep_letters_of_all_languages_and_are_no_longer_than_can_be_read() -> None:
    assert printable("Fotos\tgrün 写真 🎈") == "Fotos\tgrün 写真 🎈"
    assert printable("\udcff") == "\\udcff"
    short = message("a" + "b" * 10_000 + "c")
    assert len(short) < 1_300
    assert (short[0], short[-1]) == ("a", "c")
    assert message("b" * 1_000) == "b" * 1_000
    # what the system refuses is explained
    assert "ulimit -u" in (describe(RuntimeError("can't start new thread")) or "")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("--seed -1", "seed is -1; it must be at least 0"),
        ("--max-steps 5000001 --batch-size 2", "max_steps times batch_size is 10000002; it must be at most 10,000,000"),
        ("--threads 100000", "threads is 100000; it must be at most 512"),
        ("--sfm.matcher exhaustive --sfm.seed -1", "seed is -1; it must be a whole number from 0"),
    ],
)
def test_numbers_out_of_range_are_refused(pop, shared_capture, tmp_path, words, told):
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", *words.split())
    assert outcome.status == 2
    assert told in " ".join(outcome.err.replace("│", " ").split())
    assert not (tmp_path / "r").exists()


def test_quiet_prints_nothing_and_help_reads_forwards(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    shown = " ".join(pop("train", "--help-all").out.replace("│", " ").split())
    assert "--normalize, --no-normalize move the capture into gsplat's normalised world. (default: True)" in shown
    words = ["train", shared_capture, *TRAIN, "--max-steps", "2", "--out"]
    assert pop(*words, tmp_path / "a", "--quiet").out == ""
    assert "PSNR" in pop(*words, tmp_path / "b").out


def test_how_cameras_are_found_can_be_said_to_train(pop: Pop, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for i in range(3):
        write_photograph(tmp_path / "in" / f"{i}.png", photograph(i))
    asked: dict[str, object] = {}

    def placed(photos: Path, root: Path, **options: object) -> None:
        asked.update(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("pop_fast.data.load.run_sfm", placed)
    words = ("--sfm.camera-model", "OPENCV", "--sfm.matcher", "sequential", "--sfm.max-size", "800")
    assert pop("train", tmp_path / "in", "--out", tmp_path / "r", *words).status == 130
    assert (asked["camera_model"], asked["matcher"], asked["max_size"]) == ("OPENCV", "sequential", 800)


def test_an_unfinished_run_is_marked_and_one_without_numbers_keeps_no_other_from_being_compared(
    pop, shared_result, shared_capture, tmp_path, monkeypatch
):
    interrupt(monkeypatch, at=10)
    begun, unfinished = tmp_path / "r", tmp_path / "u"
    for out, first in ((begun, "30"), (unfinished, "5")):
        words = (*TRAIN, "--checkpoint-every", "5", "--eval-steps", first)
        assert pop("train", shared_capture, "--out", out, *words).status == 130
    _, finished, row = pop("compare", shared_result, unfinished).out.splitlines()
    assert "5 of 30, unfinished" in row
    assert "unfinished" not in finished
    assert " 1 threads" not in finished
    outcome = pop.done("compare", begun, shared_result)
    assert outcome.err.startswith(f"note: {begun}: has no statistics yet")
    _, row, finished = outcome.out.splitlines()
    assert row.split()[:2] == [shared_capture.name, "POP"]
    assert "dB" not in row
    assert f"{json.loads((shared_result / 'stats' / 'val_step0029.json').read_text())['psnr']:.2f}" in finished
    says(pop("compare", begun), f"{begun}: has no statistics yet; train to the first evaluation")


@pytest.mark.parametrize("words", ["", "--preset quick", "--max-steps 500", "--steps-scaler 0.1", "--backend cuda"])
def test_the_paper_s_schedule_is_mentioned_where_nobody_asked_for_it_on_a_cpu(words: str) -> None:
    config, _ = arguments(["scene", *words.split()])
    assert takes_hours(config) == (not words)


def test_no_gpu_is_said_where_there_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cuda_ext.why_not", lambda: "the CUDA extension is not built; run `pop build-cuda`")
    config = TrainConfig(result_dir=str(tmp_path))
    monkeypatch.setattr(choose, "has_gpu", lambda: False)
    assert choose.choose_backend(config)[1].endswith("there is no NVIDIA GPU here")
    monkeypatch.setattr(choose, "has_gpu", lambda: True)
    assert choose.choose_backend(config)[1].endswith("run `pop build-cuda`")


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes_commands_options_and_files(tmp_path: Path, pop: Pop) -> None:
    (tmp_path / "pop.bash").write_text(pop("completion", "bash").out)
    script = 'source ./pop.bash; COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); _pop; echo "${COMPREPLY[@]}"'

    def completed(*words: str) -> list[str]:
        command = ["bash", "-c", script, "-", *words]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()

    assert completed("pop", "tra") == ["train"]
    assert completed("pop", "data", "") == ["check"]
    assert "--pop.lambda-pop" in completed("pop", "train", "--pop.l")
    # the shell completes a file's name itself
    assert completed("pop", "eval", "sc") == []
    assert "complete -o default -F _pop pop" in (tmp_path / "pop.bash").read_text()
    assert set(completed("pop", "")) == {name.split()[0] for name in COMMANDS}


@pytest.mark.parametrize("columns", ["80", "300"])
def test_every_option_of_every_command_is_completed(monkeypatch, columns) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    words = {name: options_of(name) for name in COMMANDS}
    assert {"--help", "--capture", "--json"} <= set(words["eval"])
    assert {"--max-steps", "--pop.lambda-pop", "--view"} <= set(words["train"])
    assert all("--help" in options for options in words.values())
    assert "-l max-steps" in fish(words)
    assert "bashcompinit" in bash(words, zsh=True)


def test_tiles_beyond_what_a_float_counts_are_listed_in_the_right_rows() -> None:
    # one splat over 4,099 x 4,099 tiles of a pixel: past 2^24 of them a quotient in float32 is rounded
    side = 4_099
    middle = torch.tensor([[side / 2.0, side / 2.0]])
    lists = tile_lists(middle, 4.0 * middle, torch.tensor([1.0]), side, side, 1)
    assert torch.equal(lists.offsets, torch.arange(side * side + 1))


def test_the_package_gives_its_main_names_and_its_version(shared_capture: Path) -> None:
    for name in pop_fast.__all__:
        assert getattr(pop_fast, name) is not None
    assert pop_fast.__version__[0].isdigit()
    with pytest.raises(AttributeError, match="no attribute 'rasterisation'"):
        _ = pop_fast.rasterisation
    assert callable(pop_fast.rasterization)
    loaded = pop_fast.load_capture(shared_capture)
    assert repr(loaded).startswith("Capture('toy', 8 views, ")
    assert loaded._repr_html_().count("<img src=") == 8
    assert loaded.views[0]._repr_html_().count("data:image/png;base64,") == 1


def test_a_replaced_stream_is_no_obstacle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", io.StringIO())
    assert main(["--version"]) == 0


def test_a_bad_capture_and_bad_settings_are_named_before_the_work(pop: Pop, capture: Path, tmp_path: Path) -> None:
    (capture / "images" / "view_003.png").unlink()
    says(pop("train", capture, "--out", tmp_path / "r", *TRAIN), "view_003.png", "absent", "--missing skip")
    says(pop("train", capture, "--out", tmp_path / "r", "--resume", "--overwrite"), "--resume and --overwrite")
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("command", ["train", "demo", "render", "export"])
def test_a_full_disk_leaves_nothing_half_written(pop, shared_capture, shared_result, tmp_path, monkeypatch, command):
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    target = tmp_path / "here" / ("out.ply" if command == "export" else "out")
    words = {
        "train": ["train", shared_capture, "--out", target, *TRAIN],
        "demo": ["demo", target, "--views", "4", "--width", "16", "--height", "16"],
        "render": ["render", shared_result, "--out", target],
        "export": ["export", shared_result, "--out", target],
    }
    says(pop(*words[command]), str(target.parent), "the disk is full", "free some space")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        ("eval gone", ("gone", "no such file or folder")),
        ("compare", ("name one or more",)),
        ("build-cuda --jobs 0", ("jobs is 0; it must be at least 1",)),
        ("data check gone", ("gone", "no such folder")),
        ("train gone.mp4", ("gone.mp4", "no such file;")),
        ("compare gone.ply", ("gone.ply", "no such file or folder", "pop train")),
        ("report gone", ("gone", "no such file or folder", "pop train")),
        ("sfm gone", ("gone", "no such folder")),
        ("demo here --views 2", ("2 views", "use 4")),
        ("doctor --lpips-alex gone", ("gone", "LPIPS")),
    ],
)
def test_the_other_subcommands_name_what_is_wrong(pop, tmp_path, monkeypatch, words, parts):
    monkeypatch.chdir(tmp_path)
    says(pop(*words.split()), *parts)
    assert list(tmp_path.iterdir()) == []


# No command runs a module that lies in the current folder, nor does any process that a command starts.

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


def test_the_planted_modules_run_where_python_takes_the_current_folder_and_no_child_is_started_so(planted):
    folder, marker = planted
    for command in (python_command("-c", "import pop_fast.cli"), module_command("pop_fast.cli", "-V")):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert not marker.exists()
    for words in (["-m", "pop_fast"], ["-c", "import cv2"]):
        subprocess.run([sys.executable, *words], cwd=folder, capture_output=True)
    assert {"cv2"} < set(marker.read_text().splitlines())


def test_no_command_runs_a_module_of_the_current_folder(planted, shared_capture, shared_result):
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


# the first child comes to its end at once; where Snakemake is installed, it would be Snakemake's
ENDED = """
import shutil, sys
sys.modules["snakemake"] = None
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
    assert "out: is not a run in blocks" in said, said
