"""A run takes over its folder when it has taken a step: what cannot start writes nothing and replaces nothing."""

from __future__ import annotations

import errno
import io
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pop_fast.cli import eval as eval_command
from pop_fast.cli import explain, export, options, render
from pop_fast.cli.export import table_lines
from pop_fast.data import load, sfm
from pop_fast.demo import make
from pop_fast.errors import PopError
from pop_fast.io import formats
from pop_fast.io.formats import format_names, load_splat_file
from pop_fast.io.ply import load_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.results import ResultFolder
from tests.app.captures import photograph, write_photograph
from tests.app.conftest import TRAIN, Outcome, Pop, done
from tests.app.damage import contents, says
from tests.app.test_resume import run_to
from tests.app.tiny import Killed, assert_same_run, interrupt, killed_after, tiny_capture, tiny_config
from tests.browser import browser

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
    """Read all but what a killed writer leaves next to its target."""
    named = {path.relative_to(folder).as_posix(): data for path, data in contents(folder).items()}
    return {name: data for name, data in named.items() if not name.endswith(".partial")}


def as_bytes(files: dict[str, str]) -> dict[str, bytes]:
    return {name: text.encode() for name, text in files.items()}


@pytest.fixture
def train(pop: Pop, shared_capture: Path, result: Path) -> Callable[..., Outcome]:
    """`pop train` on the tiny capture, into the finished result where no folder is named."""
    return lambda *words, out=result: pop("train", shared_capture, "--out", out, *TRAIN, *words)


FAILING: dict[str, tuple[str, ...]] = {
    "--factor 4": ("view_001.png is 10 x 8 px", "--ssim-padding same", "--test-every 0"),
    "--factor 4 --ssim-padding same": ("view_000.png is 10 x 8 px", "--test-every 0"),
    "--factor 4 --test-every 0": ("view_000.png is 10 x 8 px", "or --ssim-padding same"),
    "--init-scale 1e300": ("scales[0, 0] of the first Gaussians is inf", "--init-scale"),
    "--lr.scales 1e6": ("is inf after 1 steps; nothing was written", "learning rate of scales"),
    "--lr.opacities inf": ("lr.opacities is inf",),
    "--pop.lambda-pop nan": ("pop.lambda_pop is nan",),
    "--target-mb -1": ("--target-mb -1 must be over 0",),
    "--final-prune 2": ("--final-prune 2 must be in [0, 1)",),
}


@pytest.mark.parametrize("words", FAILING)
def test_a_run_that_cannot_start_leaves_earlier_results_and_no_stub(train, result, tmp_path, words):
    before = contents(result)
    says(train(*words.split(), "--overwrite"), *FAILING[words])
    assert contents(result) == before
    says(train(*words.split(), out=tmp_path / "new"), *FAILING[words])
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("number", [0, 3], ids=["held out", "trained on"])
def test_a_camera_that_cannot_be_rendered_is_named_before_the_first_step(tmp_path: Path, number: int) -> None:
    capture = tiny_capture()
    views = list(capture.views)
    views[number] = replace(views[number], viewmat=np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(PopError, match=rf"tiny: camera of 0{number}\.png: viewmats.* must be rigid"):
        TrainingRun(tiny_config(tmp_path / "r"), replace(capture, views=tuple(views)))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), PopError("view 3 is bad"), MemoryError()], ids=repr)
def test_nothing_is_replaced_when_the_first_step_fails(tmp_path, error, monkeypatch):
    def failing(_: TrainingRun, last: int) -> None:
        raise error

    monkeypatch.setattr(TrainingRun, "take_steps", failing)
    folder = old_results(tmp_path / "r")
    for place, how in ((folder, {"overwrite": True}), (folder, {}), (tmp_path / "new", {})):
        with pytest.raises((type(error), PopError)):
            TrainingRun(tiny_config(place), tiny_capture(), **how).run()
    assert visible(folder) == as_bytes(OLD)
    assert not (tmp_path / "new").exists()


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
    written = {"metrics.jsonl": '{"step": 0}\n', "capture.json": "new", "notes.txt": "mine"}
    assert as_bytes(written).items() <= files.items()
    assert sorted(path.name for path in folder.iterdir() if path.is_dir()) == ["report_data"]
    # and the bits of a run in a new folder
    run_to(tmp_path / "new")
    TrainingRun(tiny_config(old_results(tmp_path / "old")), tiny_capture(), overwrite=True).run()
    assert_same_run(tmp_path / "old", tmp_path / "new")


def test_a_record_that_a_disk_takes_in_parts_is_whole_and_one_that_it_refuses_is_told_by_its_file(tmp_path):
    class Nearly(io.FileIO):
        def write(self, data: Any) -> int:
            if self.tell() > 40:
                raise OSError(errno.ENOSPC, "full")
            return super().write(data[:10])

    results = ResultFolder(tmp_path)
    results.open_metrics(0)
    results._metrics = Nearly(tmp_path / "metrics.jsonl", "w")
    results.log({"step": 0, "view": "a"})
    with pytest.raises(PopError, match=r"metrics\.jsonl: could not be written: the disk is full; free some space"):
        results.log({"step": 1, "view": "b"})
    results.close()
    assert (tmp_path / "metrics.jsonl").read_text().startswith('{"step": 0, "view": "a"}\n{"step": 1, ')


def test_a_link_to_nothing_is_no_folder_for_results(tmp_path: Path) -> None:
    (tmp_path / "r").symlink_to(tmp_path / "absent")
    with pytest.raises(PopError, match="r: is a link to nothing; choose another result folder"):
        ResultFolder(tmp_path / "r").check(resume=False, overwrite=False)


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("room", [0, 2, 4], ids=["no cfg.json", "no capture.json", "no histogram"])
def test_a_full_disk_while_results_are_replaced_brings_the_old_ones_back(tmp_path, monkeypatch, exists, room):
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


def test_results_that_a_kill_left_aside_come_back_with_a_note(train: Callable[..., Outcome], result: Path) -> None:
    def kept() -> dict[Path, bytes]:
        return {path: data for path, data in contents(result).items() if path.suffix in (".pt", ".ply")}

    before = kept()
    with killed_after(4), pytest.raises(Killed):
        begin(result)
    assert not (result / "cfg.json").exists()
    said = done(train("--resume"))
    assert "an --overwrite was cut short; the results that it had set aside are back" in said
    assert "continuing from step 30" in said
    assert kept() == before


def test_a_run_that_is_cut_off_can_be_looked_at_and_gone_on_with_in_few_words(pop, capture, tmp_path, monkeypatch):
    # photographs that are found by --images alone, and a command that is given from the folder that holds the capture
    (capture / "images").rename(capture / "shots")
    monkeypatch.chdir(tmp_path)
    interrupt(monkeypatch, at=10)
    words: tuple[Any, ...] = ("train", capture.name, "--out", "r", *TRAIN)
    assert pop(*words, "--images", "shots").status == 130
    # as after a kill: nothing was done when the run ended
    assert json.loads((tmp_path / "r" / "capture.json").read_text())["images"] == "shots"
    monkeypatch.chdir(capture)
    pop.done("eval", "../r")
    pop.done("export", "../r", "--out", "../x.ply")
    monkeypatch.chdir(tmp_path)
    interrupt(monkeypatch, at=-1)
    assert "continuing from step 7\n" in pop.done(*words, "--resume").out


def test_resuming_where_no_run_is_says_that_it_starts(train: Callable[..., Outcome], tmp_path: Path) -> None:
    said = done(train("--resume", out=tmp_path / "r"))
    assert f"nothing to resume in {tmp_path / 'r'}: starting anew\n" in said
    assert "continuing" not in said


def test_a_damaged_capture_json_is_named_on_resume(train: Callable[..., Outcome], result: Path) -> None:
    for text in ("", "[1]", '{"colour": 1}'):
        (result / "capture.json").write_text(text)
        says(train("--resume"), "capture.json", "remove it", "--images")


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


# What a command cannot do it says before the long work: nothing is loaded, searched, drawn or trained first.


class BegunError(Exception):
    """The long work has begun."""


@pytest.fixture
def nothing_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let everything that takes long fail."""

    def begun(*_: Any, **__: Any) -> None:
        raise BegunError

    for module in (render, eval_command, explain, export):
        monkeypatch.setattr(module, "load_splat", begun)
    for owner, name in (
        (options, "open_capture"),
        (load, "run_sfm"),
        (load, "read_views"),
        (sfm, "find_cameras"),
        (sfm, "measure"),
        (make, "render_view"),
        (formats, "load_splat_file"),
    ):
        monkeypatch.setattr(owner, name, begun)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with photographs, a file and a folder that are in the way, and one that may not be written."""
    for i in range(4):
        write_photograph(tmp_path / "photos" / f"{i}.png", photograph(i))
    (tmp_path / "splat.ply").write_bytes(b"")
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    return tmp_path


REFUSED: dict[str, tuple[str, tuple[str, ...]]] = {
    "no such path": ("render splat.ply --out o --path spiral", ("spiral", "one of views, orbit, ellipse, interpolate")),
    "no frames": ("render splat.ply --out o --path orbit --frames 0", ("frames is 0; give --frames 1 or more",)),
    "pictures where somebody's files are": ("render splat.ply --out folder --overwrite", ("folder", "thesis.txt")),
    "pictures where a folder is": ("render splat.ply --out folder", ("folder", "thesis.txt")),
    "pictures where a file is": ("render splat.ply --out file", ("file", "in the way")),
    "pictures under a file": ("render splat.ply --out file/o", ("file/o", "is a file")),
    "a video of no kind": ("render splat.ply --video o.gif", ("o.gif", "must end in .webm, .mp4, .avi")),
    "a video under a file": ("render splat.ply --video file/o.webm", ("file/o.webm", "is a file")),
    "numbers where a folder is": ("eval splat.ply --capture photos --json folder", ("folder", "in the way")),
    "numbers under a file": ("eval splat.ply --capture photos --json file/o.json", ("file/o.json", "is a file")),
    "a page where a folder is": ("explain splat.ply --view 0 --pixel 1,1 --html folder", ("folder", "in the way")),
    "maps where a folder is": ("explain splat.ply --view 0 --maps folder", ("folder", "--overwrite")),
    "an export under a file": ("export splat.ply --out file/o.spz", ("file/o.spz", "is a file")),
    "an export of no format": ("export splat.ply --out o.xyz", ("o.xyz", ".spz")),
    "an Inria folder that is in use": ("export splat.ply --layout inria --out folder", ("folder", "thesis.txt")),
    "a conversion under a file": ("convert splat.ply file/o.spz", ("file/o.spz", "is a file")),
    "cameras where a folder is": ("sfm photos --out folder", ("folder", "thesis.txt")),
    "cameras under a file": ("sfm photos --out file/o", ("file/o", "is a file")),
    "a demo where somebody's files are": ("demo folder --overwrite", ("folder", "thesis.txt")),
    "a demo under a file": ("demo file/o", ("file/o", "is a file")),
    "a factor that leaves nothing": ("train photos --factor 1000", ("0.png", "40x30", "factor 1000", "use 30 at most")),
    "results under a file": ("train photos --out file/o", ("file/o", "is a file")),
    "weights that are not there": ("train photos --lpips-alex gone.pth", ("gone.pth", "--lpips-alex")),
}


@pytest.mark.usefixtures("nothing_long")
@pytest.mark.parametrize("what", REFUSED)
def test_it_is_said_before_the_long_work(pop: Pop, place: Path, what: str) -> None:
    command, words = REFUSED[what]
    says(pop(*command.split()), *words)
    assert (place / "folder" / "thesis.txt").read_text() == "mine"


@pytest.mark.usefixtures("nothing_long")
@pytest.mark.parametrize(
    "command",
    [
        *("render splat.ply --out locked/o", "sfm photos --out locked/o", "train photos --out locked/o"),
        *("train photos --out locked --overwrite", "train photos --out locked --resume"),
    ],
)
def test_a_folder_that_may_not_be_written_to_is_said_before_the_long_work(
    pop: Pop, place: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    (place / "locked").mkdir()
    (place / "locked" / "cfg.json").write_text(TrainConfig().to_json())
    # root may write anywhere
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked")
    says(pop(*command.split()), "locked", "permission denied")


@pytest.mark.usefixtures("nothing_long")
def test_what_can_be_done_goes_on_to_the_long_work(pop: Pop, place: Path) -> None:
    for command in ("render splat.ply --out o", "train photos --factor 2", "sfm photos --out o", "demo o"):
        with pytest.raises(BegunError):
            pop(*command.split())
    assert np.all([not (place / name).exists() for name in ("o", "out")])


# What `pop train` writes when the last step is taken: exports, the viewer's page, the table of sizes, the report.

LAST = "stats/val_step0029.json"


def test_a_run_ends_with_its_size_in_every_format(shared_result: Path) -> None:
    stats = json.loads((shared_result / LAST).read_text())
    assert [entry["format"] for entry in stats["encodings"]] == list(format_names())
    by_name = {entry["format"]: entry for entry in stats["encodings"]}
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    assert {entry["num_gaussians"] for entry in stats["encodings"]} == {n}
    assert 248 * n < by_name["ply"]["bytes"] < 248 * n + 3000
    assert by_name["splat"]["bytes"] == 32 * n
    assert by_name["spz"]["bytes"] < by_name["ply"]["bytes"] / 5
    assert by_name["ply"]["views"] == 1
    assert by_name["ply"]["psnr"] == pytest.approx(stats["psnr"], abs=1e-3)
    # what comes back from glTF is what went in; of the others little is lost
    assert by_name["gltf"]["psnr"] == pytest.approx(by_name["ply"]["psnr"], abs=1e-3)
    for name in ("spz", "sog", "compressed-ply"):
        assert by_name[name]["psnr"] == pytest.approx(by_name["ply"]["psnr"], abs=0.2)


def test_the_table_is_printed_and_the_report_shows_it(train: Callable[..., Outcome], result: Path) -> None:
    lines = done(train("--resume")).splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("format "))
    assert [line.split()[0] for line in lines[head + 1 : head + 1 + len(format_names())]] == list(format_names())
    page = (result / "report.html").read_text()
    assert "<h2>Files</h2>" in page
    assert all(f"<td>{name}</td>" in page for name in format_names())
    assert '<iframe class="viewer"' in page
    # it has its first column to the left
    assert table_lines([("a", "bb"), ("ccc", "d")]) == ["a    bb", "ccc   d"]


def test_exports_are_written_with_the_limits_that_are_asked_for_and_go_with_their_run(train, result):
    words = ("--export", "spz", "gltf-spz", "html", "--max-gaussians", "100", "--skip-sizes")
    said = done(train("--resume", *words))
    assert "highest sensitivity: 100 of" in said
    assert "format " not in said
    names = sorted(path.name for path in (result / "export").iterdir())
    assert names == ["result-spz.glb", "result.html", "result.spz"]
    assert len(load_splat_file(result / "export" / "result.spz")[0]["means"]) == 100
    # what was trained stays whole
    assert len(load_ply(result / "ply" / "point_cloud_29.ply")["means"]) > 100
    # a new run replaces the page and the exports of the old one
    done(train("--overwrite"))
    assert not (result / "export").exists()
    assert (result / "viewer.html").is_file()


def test_limits_without_a_format_make_a_ply_in_the_frame_of_the_capture(pop, train, result, tmp_path):
    done(train("--resume", "--final-prune", "0", "--min-opacity", "0", "--skip-sizes"))
    pop.done("export", result, "--out", tmp_path / "whole.ply")
    kept, whole = (load_ply(path)["means"] for path in (result / "export" / "result.ply", tmp_path / "whole.ply"))
    assert {tuple(row) for row in kept.tolist()} <= {tuple(row) for row in whole.tolist()}


def test_an_export_that_cannot_be_written_leaves_the_results_and_says_so(train, result):
    outcome = train("--resume", "--export", "spz", "--target-mb", "1e-5")
    assert outcome.status == 1
    assert "a file without any Gaussian has" in outcome.err
    assert f"the results in {result} are complete; the same command writes the rest" in outcome.err
    assert not (result / "export").exists()
    assert outcome.out.endswith(f"report: {result / 'report.html'}\n")


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({}, "encodings is dict"),
        ([{"format": "ply"}], "encodings[0].bytes is absent"),
        ([{"format": "ply", "bytes": "many", "num_gaussians": 1, "psnr": None, "views": 0}], "encodings[0].bytes"),
        ([7], "encodings[0].format"),
    ],
)
def test_a_damaged_entry_of_the_statistics_is_named(pop: Pop, result: Path, entries: object, said: str) -> None:
    stats = json.loads((result / LAST).read_text())
    (result / LAST).write_text(json.dumps({**stats, "encodings": entries or {"a": 1}}))
    says(pop("report", result), said)


def test_a_result_without_a_page_or_with_that_of_another_version_has_a_report(pop: Pop, result: Path) -> None:
    # the same text and more is another script
    viewer = result / "viewer.html"
    viewer.write_text(viewer.read_text().replace("</script></body>", "window.other = 1</script></body>"))
    pop.done("report", result)
    assert 'in <a href="viewer.html">viewer.html</a>' in (result / "report.html").read_text()
    assert "<iframe" not in (result / "report.html").read_text()
    # as of before there was one
    stats = json.loads((result / LAST).read_text())
    del stats["encodings"]
    (result / LAST).write_text(json.dumps(stats))
    viewer.unlink()
    pop.done("report", result)
    page = (result / "report.html").read_text()
    assert "<h2>Files</h2>" not in page
    assert "<iframe" not in page


def test_the_report_shows_the_splat_in_a_frame(result: Path, tmp_path: Path) -> None:
    shutil.copy(result / "report.html", tmp_path / "report.html")
    with browser(tmp_path / "browser") as tab:
        tab.open(tmp_path / "report.html", 1000, 800)
        tab.wait_for("document.readyState === 'complete'")
        tab.value("document.querySelector('iframe.viewer').scrollIntoView()")
        tab.wait_for("document.querySelector('iframe.viewer').contentDocument?.getElementById('view')?.dataset.drawn")
        picture = tab.screenshot()
        assert all(url.startswith(("file:", "blob:", "about:", "data:")) for url in tab.requests)
        assert tab.errors == []
    assert picture.std() > 10.0
