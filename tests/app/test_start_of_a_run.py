"""A run takes over its folder when it has taken a step: what cannot start writes nothing and replaces nothing."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_fast.errors import PopError
from pop_fast.train import LearningRates, TrainingRun
from pop_fast.train.results import ResultFolder
from tests.app.conftest import TRAIN, Pop
from tests.app.damage import contents, says
from tests.app.interruptions import Killed, interrupt, killed_after
from tests.app.test_resume import assert_same_run, run_to
from tests.app.tiny import tiny_capture, tiny_config

# in a folder of results: small files and folders, under names that a run writes and one that it does not
OLD = {
    "cfg.json": "{}",
    "capture.json": "old",
    "metrics.jsonl": "old",
    "ckpts/ckpt_9_rank0.pt": "old",
    "report_data/opacity_step-1.npz": "old",
    "notes.txt": "mine",
}


def old_results(folder: Path) -> Path:
    for name, text in OLD.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def visible(folder: Path) -> dict[str, bytes]:
    """Read all but what a killed writer leaves beside its target."""
    named = {path.relative_to(folder).as_posix(): data for path, data in contents(folder).items()}
    return {name: data for name, data in named.items() if not name.endswith(".partial")}


def as_bytes(files: dict[str, str]) -> dict[str, bytes]:
    return {name: text.encode() for name, text in files.items()}


FAILING: list[tuple[list[str], tuple[str, ...]]] = [
    (["--factor", "4"], ("view_001.png is 10 x 8 px", "--ssim-padding same", "--test-every 0")),
    (["--factor", "4", "--ssim-padding", "same"], ("view_000.png is 10 x 8 px", "--test-every 0")),
    (["--factor", "4", "--test-every", "0"], ("view_000.png is 10 x 8 px", "or --ssim-padding same")),
    (["--init-scale", "1e300"], ("scales[0, 0] of the first Gaussians is inf", "--init-scale")),
    (["--lr.scales", "1e6"], ("is inf after 1 steps; nothing was written", "learning rate of scales")),
    (["--lr.opacities", "inf"], ("lr.opacities is inf",)),
    (["--pop.lambda-pop", "nan"], ("pop.lambda_pop is nan",)),
]


@pytest.mark.parametrize(("words", "parts"), FAILING, ids=[" ".join(words) for words, _ in FAILING])
def test_a_run_that_cannot_start_leaves_earlier_results_and_no_stub(
    pop: Pop, shared_capture: Path, result: Path, tmp_path: Path, words: list[str], parts: tuple[str, ...]
) -> None:
    before = contents(result)
    says(pop("train", shared_capture, "--out", result, *TRAIN, *words, "--overwrite"), *parts)
    assert contents(result) == before
    says(pop("train", shared_capture, "--out", tmp_path / "new", *TRAIN, *words), *parts)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("number", [0, 3], ids=["held out", "trained on"])
def test_a_camera_that_cannot_be_rendered_is_named_before_the_first_step(tmp_path: Path, number: int) -> None:
    capture = tiny_capture()
    views = list(capture.views)
    views[number] = replace(views[number], viewmat=np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(PopError, match=rf"tiny: camera of 0{number}\.png: viewmats.* must be rigid"):
        TrainingRun(tiny_config(tmp_path / "r"), replace(capture, views=tuple(views)))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PopError("view 3 is bad"), MemoryError()], ids=repr)
def test_nothing_is_replaced_when_the_first_step_fails(
    tmp_path: Path, error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(_: TrainingRun, last: int) -> None:
        raise error

    monkeypatch.setattr(TrainingRun, "take_steps", failing)
    folder = old_results(tmp_path / "r")
    for place, how in ((folder, {"overwrite": True}), (folder, {}), (tmp_path / "new", {})):
        with pytest.raises((type(error), PopError)):
            TrainingRun(tiny_config(place), tiny_capture(), **how).run()
    assert visible(folder) == as_bytes(OLD)
    assert not (tmp_path / "new").exists()


def test_a_first_step_that_ruins_the_parameters_replaces_nothing(tmp_path: Path) -> None:
    folder = old_results(tmp_path / "r")
    trainer = TrainingRun(tiny_config(folder, lr=LearningRates(scales=1e6)), tiny_capture(), overwrite=True)
    with pytest.raises(PopError, match="nothing was written"):
        trainer.run()
    assert visible(folder) == as_bytes(OLD)


def begin(folder: Path, overwrite: bool = True) -> ResultFolder:
    results = ResultFolder(folder)
    results.log({"step": 0})
    try:
        results.begin(tiny_config(folder), {"capture.json": "new"}, np.full(3, 0.5), overwrite)
    finally:
        results.close()
    return results


def test_the_new_run_has_only_what_it_wrote_and_what_is_not_a_result(tmp_path: Path) -> None:
    folder = old_results(tmp_path / "r")
    begin(folder)
    files = visible(folder)
    assert set(files) == {"cfg.json", "capture.json", "metrics.jsonl", "report_data/opacity_step-1.npz", "notes.txt"}
    assert files["metrics.jsonl"] == b'{"step": 0}\n'
    assert as_bytes({"capture.json": "new", "notes.txt": "mine"}).items() <= files.items()
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == ["report_data"]


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("room", [0, 2, 4], ids=["no cfg.json", "no capture.json", "no histogram"])
def test_a_full_disk_while_results_are_replaced_brings_the_old_ones_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exists: bool, room: int
) -> None:
    folder = old_results(tmp_path / "r") if exists else tmp_path / "r"
    fsync, done = os.fsync, 0

    def full(handle: int) -> None:
        # each file is flushed, then its folder
        nonlocal done
        done += 1
        if done > room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(PopError, match="the disk is full"):
        begin(folder)
    assert visible(folder) == (as_bytes(OLD) if exists else {})
    assert folder.exists() == exists


def survives(call: Callable[[], object], changes: int) -> bool:
    """Call in a process that is killed after so many changes of the disk; False when it was."""
    try:
        with killed_after(changes):
            call()
    except Killed:
        return False
    return True


def killed_and_killed_again(folder: Path, changes: int, more: int) -> tuple[bool, bool, bool]:
    """Replace old results and repair that, each cut short, then repair; returns which lived and whether all is old."""
    old = {name: text for name, text in OLD.items() if name != "capture.json"}
    (old_results(folder) / "capture.json").unlink()
    began = survives(lambda: begin(folder), changes)
    repaired = survives(lambda: ResultFolder(folder).check(resume=False, overwrite=True), more)
    ResultFolder(folder).check(resume=False, overwrite=True)
    files = visible(folder)
    assert not (folder / ".replaced").exists()
    # a run without a step may be lost, but never mixed with the one before it
    if files != as_bytes(old):
        assert json.loads(files["cfg.json"])["resolved"]["seed"] == 7
        assert b"old" not in files.values()
    return began, repaired, files == as_bytes(old)


def test_a_replacement_that_is_killed_anywhere_is_undone_or_was_complete(tmp_path: Path) -> None:
    kept: list[bool] = []
    began = old = False
    for changes in range(100):
        for more in range(100):
            began, repaired, old = killed_and_killed_again(tmp_path / f"{changes} {more}", changes, more)
            if repaired:
                break
        kept.append(old)
        if began:
            break
    assert began
    assert kept == sorted(kept, reverse=True)
    assert set(kept) == {True, False}


def test_results_that_a_kill_left_aside_come_back_with_a_note(pop: Pop, shared_capture: Path, result: Path) -> None:
    before = contents(result)
    with killed_after(4), pytest.raises(Killed):
        begin(result)
    assert not (result / "cfg.json").exists()
    again = pop("train", shared_capture, "--out", result, *TRAIN, "--resume")
    assert again.status == 0, again.err
    assert "an --overwrite was cut short; the results that it had set aside are back" in again.out
    assert "continuing from step 30" in again.out
    assert {path: data for path, data in contents(result).items() if path.suffix in (".pt", ".ply")} == {
        path: data for path, data in before.items() if path.suffix in (".pt", ".ply")
    }


def test_a_run_that_replaced_another_has_the_bits_of_one_in_a_new_folder(tmp_path: Path) -> None:
    run_to(tmp_path / "new")
    TrainingRun(tiny_config(old_results(tmp_path / "r")), tiny_capture(), overwrite=True).run()
    assert_same_run(tmp_path / "r", tmp_path / "new")


@pytest.fixture
def odd_capture(capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture whose photographs are found by --images alone; commands are given from the folder that holds it."""
    (capture / "images").rename(capture / "shots")
    monkeypatch.chdir(tmp_path)
    return capture


def test_a_run_that_is_cut_off_can_be_looked_at_and_gone_on_with_in_few_words(
    pop: Pop, odd_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupt(monkeypatch, at=10)
    words: tuple[Any, ...] = ("train", odd_capture.name, "--out", "r", *TRAIN)
    assert pop(*words, "--images", "shots").status == 130
    # as after a kill: nothing was done when the run ended
    assert json.loads((tmp_path / "r" / "capture.json").read_text())["images"] == "shots"
    monkeypatch.chdir(odd_capture)
    evaluated = pop("eval", "../r")
    assert evaluated.status == 0, evaluated.err
    exported = pop("export", "../r", "--out", "../x.ply")
    assert exported.status == 0, exported.err
    monkeypatch.chdir(tmp_path)
    interrupt(monkeypatch, at=-1)
    again = pop(*words, "--resume")
    assert again.status == 0, again.err
    assert "continuing from step 7\n" in again.out


def test_resuming_where_no_run_is_says_that_it_starts(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "r", *TRAIN, "--resume")
    assert outcome.status == 0, outcome.err
    assert f"nothing to resume in {tmp_path / 'r'}: starting anew\n" in outcome.out
    assert "continuing" not in outcome.out


def test_a_damaged_capture_json_is_named_on_resume(pop: Pop, shared_capture: Path, result: Path) -> None:
    for text in ("", "[1]", '{"colour": 1}'):
        (result / "capture.json").write_text(text)
        says(pop("train", shared_capture, "--out", result, *TRAIN, "--resume"), "capture.json", "remove it", "--images")


def test_what_a_run_left_that_was_killed_while_it_wrote_its_first_file_is_nobody_s(tmp_path):
    # of a process that has ended
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    left = tmp_path / f".cfg.json.{child.pid}.partial"
    left.write_text("{")
    for resume in (True, False):
        ResultFolder(tmp_path).check(resume=resume, overwrite=False)
    TrainingRun(tiny_config(tmp_path, max_steps=2), tiny_capture(), resume=True).run()
    assert not left.exists()
    assert (tmp_path / "cfg.json").is_file()


@pytest.mark.parametrize("name", [f".cfg.json.{os.getppid()}.partial", "cfg.json.partial", ".cfg.json.x.partial"])
def test_what_a_living_writer_or_somebody_else_has_there_is_kept(tmp_path, name):
    (tmp_path / name).write_text("{")
    with pytest.raises(PopError, match="exists and is not empty"):
        ResultFolder(tmp_path).check(resume=False, overwrite=False)
    assert (tmp_path / name).read_text() == "{"
