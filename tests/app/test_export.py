"""`pop export` and `pop convert`: the same splat, in files that other programs open, each of which says its world.

Within a budget: which Gaussians go, colours of fewer bands, and tuning that leaves no trace.
"""

from __future__ import annotations

import ast
import json
import os
import re
import shutil
import typing
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from benchmarks.faults.corpus import ksplat_of
from benchmarks.faults.runs import same
from pop_fast.cli import main
from pop_fast.cli.options import FormatName, Output
from pop_fast.data import load_capture
from pop_fast.data.colmap import read_model
from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.io.formats import FORMATS, default_name, encoded, format_names, levels, load_splat_file
from pop_fast.io.ply import Frame, frame_of, load_ply, save_ply
from pop_fast.train import compact
from pop_fast.train.appearance import Appearance
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture
from pop_fast.train.views import ViewTensors
from tests.app.captures import assert_one_line, many
from tests.app.conftest import ROOT, TRAIN, Pop
from tests.app.damage import contents, says
from tests.app.tiny import tiny_capture

TRAINING = ("--frame", "training")
Said, Psnr = Callable[..., str], Callable[..., float]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


@pytest.fixture
def export(pop: Pop, shared_result: Path) -> Said:
    return lambda *words: pop.done("export", shared_result, *words).out


@pytest.fixture
def psnr(pop: Pop, shared_capture: Path) -> Psnr:
    """Measure a splat on the tiny capture, without a note."""

    def measure(*words: object) -> float:
        assert "note" not in pop.done("eval", *words, "--capture", shared_capture, "--json", "e.json").err
        return json.loads(Path("e.json").read_text())["psnr"]

    return measure


@pytest.fixture
def own(shared_result: Path) -> Path:
    """The PLY of the tiny result."""
    return shared_result / "ply" / "point_cloud_29.ply"


@pytest.fixture
def trained(shared_result: Path) -> Any:
    stats = json.loads((shared_result / "stats" / "val_step0029.json").read_text())
    return pytest.approx(stats["psnr"], abs=1e-2)


def test_the_frame_is_found_from_the_capture_where_no_record_was_left(pop: Pop, result: Path) -> None:
    pop.done("export", result, "--out", "a.ply")
    (result / "capture.json").unlink()
    pop.done("export", result, "--out", "b.ply")
    assert Path("a.ply").read_bytes() == Path("b.ply").read_bytes()


def test_what_no_renderer_shows_is_left_out_and_counted(pop: Pop, psnr: Psnr, own: Path) -> None:
    params = load_ply(own)
    params["opacities"][:7] = torch.logit(torch.tensor(0.0039))  # just under 1/255 = 0.00392...
    save_ply("with.ply", params, frame=frame_of(own))
    n = len(params["means"])
    said = pop.done("export", "with.ply", "--out", "without.ply", "--drop-invisible", *TRAINING).out
    assert f"{n - 7:,} of {n:,} Gaussians kept, 7 left out" in said
    assert len(load_ply("without.ply")["means"]) == n - 7
    assert psnr("without.ply") == psnr("with.ply")


def test_inria_s_layout_has_what_its_scripts_read(export: Said, psnr: Psnr, shared_capture: Path, trained: Any) -> None:
    export("--out", "inria", "--layout", "inria")
    export("--out", "own.ply")
    (ply,) = Path("inria").rglob("*.ply")
    assert ply == Path("inria/point_cloud/iteration_30/point_cloud.ply")
    exported = load_ply(ply)
    for name, value in load_ply("own.ply").items():
        torch.testing.assert_close(exported[name], value)
    assert psnr(ply) == trained
    assert frame_of(ply) == frame_of("own.ply")
    views = Path("inria/test/ours_30")
    assert (
        [p.name for p in (views / "renders").iterdir()] == [p.name for p in (views / "gt").iterdir()] == ["00000.png"]
    )
    photo = cv2.imread(str(shared_capture / "images" / "view_000.png"))
    np.testing.assert_array_equal(cv2.imread(str(views / "gt" / "00000.png")), photo)
    call = ast.parse(Path("inria/cfg_args").read_text(), mode="eval").body
    settings = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    assert settings["source_path"] == str(shared_capture)
    assert settings["white_background"] is False
    # Inria's load_ply asserts it, and the run's last steps did not reach the last degree
    columns = sum(name.startswith("f_rest_") for name in PlyData.read(ply)["vertex"].data.dtype.names)
    assert columns == 3 * (settings["sh_degree"] + 1) ** 2 - 3
    cameras = json.loads(Path("inria/cameras.json").read_text())
    shots, _ = read_model(shared_capture / "sparse" / "0")
    assert len(cameras) == len(shots) == len(load_capture(shared_capture).views)
    for camera, shot in zip(cameras, shots, strict=True):
        assert camera["img_name"] == Path(shot.name).stem
        np.testing.assert_allclose(camera["rotation"], shot.viewmat[:3, :3].T, atol=1e-9)
        np.testing.assert_allclose(camera["position"], -shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3], atol=1e-9)
        assert camera["fx"] == pytest.approx(shot.camera.focal_length_x)


def test_a_file_says_how_it_is_drawn_where_not_as_usual(pop: Pop, psnr: Psnr, result: Path, own: Path) -> None:
    as_usual = psnr(result)
    settings = json.loads((result / "cfg.json").read_text())
    inria = {"profile": "inria", "near_plane": 0.4, "eps2d": 2.0}
    settings["resolved"] |= inria
    (result / "cfg.json").write_text(json.dumps(settings))
    measured = psnr(result)
    assert abs(measured - as_usual) > 0.1
    for name in set(format_names()) - {"splat"}:
        pop.done("export", result, "--to", name)
        file = Path(default_name(result.name, name))
        assert dict(load_splat(file).config.drawn) == inria, name
        # what the training frame calls 0.4 is further away in the capture's own
        pop.done("convert", file, f"{name}.ply")
        assert psnr(f"{name}.ply") == pytest.approx(measured, abs=0.05), name
    pop.done("export", result, "--to", "ply", "--overwrite", "--frame", "training")
    assert psnr(f"{result.name}.ply") == pytest.approx(measured, abs=1e-3)
    lost = "splat cannot record that its run drew it with profile inria, near_plane 0.4, eps2d 2.0; programs that read"
    for words in (("export", result, "--out", "a.splat"), ("convert", f"{result.name}.ply", "b.splat", "--overwrite")):
        assert lost in pop.done(*words).err
    assert "draw" not in pop.done("export", own, "--out", "c.splat").err
    # splats that are drawn as usual say nothing of it
    assert b"pop-drawn" not in own.read_bytes()[:2000]
    damaged = Path(f"{result.name}.ply").read_bytes().replace(b'"inria"', b'"other"')
    Path("damaged.ply").write_bytes(damaged)
    says(pop("eval", "damaged.ply"), "damaged.ply: is to be drawn by settings that cannot be: profile is 'other'")
    # no JSON, and a whole number that no float holds
    for entry in (b'"oth r', b'"inria", "eps2d": 1' + 310 * b"0"):
        Path("damaged.ply").write_bytes(damaged.replace(b'"other"', entry).replace(b', "eps2d": 2.0', b""))
        says(pop("eval", "damaged.ply"), "damaged.ply: comment 'pop-drawn:")


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("", "nothing to write; give --out FILE or --to FORMAT"),
        ("--out x.spz --to sog", "ends in .spz, which is not how files of sog end"),
        ("--out x.ply --to html", "a page ends in .html"),
        ("--out x.html --frame capture", "a page has no frame of its own"),
        ("--out x.ply --min-opacity 1.5", "--min-opacity 1.5 must be in [0, 1]"),
        ("--out x.ply --crop 1 0 0 0 1 1", "each minimum under its maximum"),
        ("--out x.ply --crop 91 91 91 99 99 99", "in the box leaves no Gaussian"),
        ("--out x.ply --final-prune 1", "--final-prune 1 must be in [0, 1)"),
        ("--out x.ply --max-gaussians 0", "--max-gaussians 0 must be at least 1"),
        ("--out x.ply --target-mb 0", "--target-mb 0 must be over 0"),
        ("--out x.ply --target-mb 0.0001", "a file without any Gaussian has"),
        ("--out x.spz --target-mb nan", "--target-mb nan must be over 0 and finite"),
        ("--out x.spz --target-mb inf", "--target-mb inf must be over 0 and finite"),
        ("--out x.spz --target-mb 1 --fine-tune-steps -1", "--fine-tune-steps -1 must be 0 to 30,000"),
        ("--out x.spz --target-mb 1 --fine-tune-steps 30001", "--fine-tune-steps 30001 must be 0 to 30,000"),
        ("--out x --layout inria --max-gaussians 5", "no --to or limits"),
        ("--out x --layout inria --drop-invisible", "no --drop-invisible"),
        ("--out x --layout inria --frame training", "no --frame training"),
        ("--out x.obj", "must end in one of .compressed.ply, .glb, .ply, .sog, .splat, .spz"),
        ("--out there.ply", "exists; pass --overwrite"),
        ("--out full --layout inria", "full: holds what this command did not write (notes.txt)"),
        ("--out full --layout inria --overwrite", "did not write (notes.txt)"),
        ("--out full.ply --overwrite", "full.ply: a folder of this name is in the way; choose another name"),
    ],
)
def test_what_cannot_be_exported_is_said(pop: Pop, shared_result: Path, here: Path, words: str, part: str) -> None:
    for folder in ("full", "full.ply"):
        Path(folder).mkdir()
    for file in ("there.ply", "full/notes.txt"):
        Path(file).write_text("mine")
    before = sorted(here.rglob("*"))
    says(pop("export", shared_result, *words.split()), part)
    assert sorted(here.rglob("*")) == before
    assert Path("there.ply").read_text() == "mine"


@pytest.mark.parametrize("damage", ["none", "another trainer's", "measured", "no cfg_args"])
def test_only_our_own_inria_folder_is_replaced(pop: Pop, shared_result: Path, here: Path, damage: str) -> None:
    words = ["export", shared_result, "--layout", "inria", "--out", "inria"]
    pop.done(*words)
    settings, before = Path("inria/cfg_args"), contents(here)
    if damage == "none":
        Path("inria/test/ours_30/gt/00001.png").write_bytes(b"of a longer test set")
        says(pop(*words), "inria: the folder exists and is not empty; choose another or pass --overwrite")
        pop.done(*words, "--overwrite")
    else:
        if damage == "another trainer's":
            settings.write_text(settings.read_text().replace(", exported_by='pop export'", ""))
        elif damage == "measured":
            Path("inria/results.json").write_text("{}")
        else:
            settings.unlink()
        before = contents(here)
        said = {"measured": "(results.json)", "no cfg_args": "(cameras.json"}.get(damage, "(cameras.json, cfg_args")
        outcome = pop(*words, "--overwrite")
        says(outcome, "inria: holds what this command did not write", said, "move these files away")
    assert contents(here) == before


def test_an_export_never_replaces_what_it_reads(pop: Pop, capture: Path, result: Path, tmp_path: Path) -> None:
    words = ["export", result, "--capture", capture, "--overwrite", "--layout", "inria", "--out"]
    pop.done(*words, "inria")
    before = contents(tmp_path)
    for read in (capture, result):
        says(pop(*words, read), f"{read}: is read by this command, so it is not replaced")
    lone = Path("inria/point_cloud/iteration_30/point_cloud.ply")
    again = ["export", lone, "--capture", capture, "--own-frame", "--overwrite"]
    says(pop(*again, "--layout", "inria", "--out", "inria"), "inria: holds", "point_cloud.ply, which is read")
    says(pop(*again, "--out", lone), "point_cloud.ply: is the input file; choose another name")
    assert contents(tmp_path) == before


def test_every_format_has_a_name_of_its_own_among_those_that_nobody_chose(export: Said) -> None:
    names = typing.get_args(FormatName)
    assert set(names) == {*format_names(), "html"}
    for name in names:
        export("--to", name)
    files = list(Path().iterdir())
    assert len(files) == len(names)
    assert all(path.suffix == ".html" or len(load_splat_file(path).params["means"]) > 0 for path in files)


def test_a_box_is_in_the_frame_of_the_capture(pop: Pop, export: Said) -> None:
    export("--out", "own.ply")
    export("--out", "t.ply", *TRAINING)
    whole = load_ply("own.ply")["means"]
    box = [f"{value:.6f}" for share in (0.2, 0.9) for value in whole.quantile(share, dim=0).tolist()]
    low, high = torch.tensor([float(value) for value in box]).split(3)
    export("--out", "box.ply", "--crop", *box)
    for name in ("own", "t"):
        pop.done("convert", f"{name}.ply", f"{name}_box.ply", "--crop", *box)
    kept = load_ply("box.ply")["means"]
    assert 0 < len(kept) < len(whole)
    assert ((kept >= low - 1e-5) & (kept <= high + 1e-5)).all()
    found = {len(kept), *(len(load_ply(f"{name}_box.ply")["means"]) for name in ("own", "t"))}
    assert found == {int(((whole >= low) & (whole <= high)).all(1).sum())}


def test_limits_are_applied_one_after_the_other_and_said(export: Said, own: Path) -> None:
    n = len(load_ply(own)["means"])
    limits = ("--min-opacity", "0.0039", "--final-prune", "0.003", "--max-gaussians", n // 2)
    said = export("--out", "x.ply", *limits)
    assert f"opacity >= 0.0039: {n:,} of {n:,} Gaussians kept" in said
    assert "all but 0.30% of the blending weights: " in said
    assert f"highest sensitivity: {n // 2:,} of" in said
    assert len(load_ply("x.ply")["means"]) == n // 2


def test_a_limit_that_leaves_none_out_changes_nothing(export: Said, own: Path) -> None:
    n = len(load_ply(own)["means"])
    export("--out", "whole.ply")
    assert f"highest sensitivity: {n:,} of {n:,}" in export("--out", "x.ply", "--max-gaussians", n)
    assert Path("x.ply").read_bytes() == Path("whole.ply").read_bytes()


def test_scores_of_views_need_a_capture(pop: Pop, export: Said) -> None:
    export("--out", "a.ply")
    said = pop.done("export", "a.ply", "--out", "b.spz", "--max-gaussians", "20").out
    assert "highest visibility: 20 of" in said
    needs = "contributions is summed over the training views; give --capture DIR"
    says(pop("export", "a.ply", "--out", "c.spz", "--final-prune", "0.01"), needs)


def test_a_conversion_writes_a_page_and_what_its_name_promises(pop: Pop, export: Said) -> None:
    export("--out", "a.ply")
    said = pop.done("convert", "a.ply", "b.html").out
    assert f"Gaussians, {Path('b.html').stat().st_size / 1e6:.2f} MB -> b.html" in said
    assert Path("b.html").read_text().startswith("<!doctype html>")
    save_ply("t.ply", load_ply("a.ply"), frame=Frame("training"))
    assert "Gaussians, " in pop.done("convert", "t.ply", "t.html").out
    # a file name is bytes, and need be no text
    odd = Path("t.ply").rename(os.fsdecode(b"t\xff.ply"))
    pop.done("convert", odd, "odd.html")
    assert r"<title>t\udcff.ply</title>" in Path("odd.html").read_text(encoding="utf-8")
    export("--out", "a.compressed.ply")
    header = Path("a.compressed.ply").read_bytes().partition(b"end_header")[0]
    assert b"packed_position" in header
    assert b"f_dc_0" not in header


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("gone.ply b.spz", "gone.ply: the PLY file is absent"),
        ("gone.sog b.spz", "gone.sog: the file is absent"),
        ("a.ply b.obj", "must end in one of"),
        ("a.ply a.ply", "is the input file"),
        ("a.ply there.spz", "exists; pass --overwrite"),
        ("a.ply b.html --to sog", "a page ends in .html, but --to is sog"),
        ("a.ply b.ksplat", "b.ksplat: is of a format that is read and not written"),
        ("a.ply meta.json", "meta.json: is of a format that is read and not written"),
        ("t.ply b.spz --crop 0 0 0 1 1 1", "t.ply: is in a training frame"),
        ("a.ply b.spz --score dominance", "--score dominance needs the training views"),
        ("a.ply b.spz --final-prune 0.01", "--final-prune needs the training views; 'pop export a.ply --capture DIR'"),
        ("a.ply b.spz --without-floaters", "--without-floaters needs the training views"),
        ("empty.spz b.ply", "empty.spz: is cut off in its header"),
        ("empty.splat2 b.ply", "must end in one of"),
        (". b.ply", "is a folder without SOG's meta.json; 'pop export' reads the folder of a training"),
    ],
)
def test_what_cannot_be_converted_is_said(pop: Pop, export: Said, words: str, part: str) -> None:
    export("--out", "a.ply")
    save_ply("t.ply", load_ply("a.ply"), frame=Frame("training"))
    for file in ("there.spz", "empty.spz"):
        Path(file).touch()
    says(pop("convert", *words.split()), part)
    assert not Path("b.ply").exists()


def test_sog_folders_and_ksplat_are_converted(pop: Pop, export: Said, psnr: Psnr) -> None:
    export("--out", "a.sog")
    with zipfile.ZipFile("a.sog") as archive:
        archive.extractall("folder")
    params = load_splat_file(Path("a.sog")).params
    Path("a.ksplat").write_bytes(ksplat_of(params, 0))
    of_sog = psnr("a.sog")
    for source in ("folder", "folder/meta.json", "a.ksplat"):
        out = f"{source.replace('/', '_')}.ply"
        pop.done("convert", source, out)
        for file in (source, out):
            # KSPLAT has no room for the frame, which is the capture's here
            told = ["--own-frame"] if "ksplat" in file else []
            assert abs(psnr(file, *told) - of_sog) < 0.01, file


# A PLY says which world it is in, so that what is exported measures as what was trained, without being told.


def test_an_export_measures_as_its_run_moved_into_the_other_frame_and_back(
    pop, export, psnr, own, shared_result, trained
):
    record = json.loads((shared_result / "capture.json").read_text())
    found = frame_of(own)
    assert found.name == "training"
    np.testing.assert_array_equal(np.array(found.transform), np.array(record["world_transform"]))
    # the training frame keeps every bit
    export("--out", "t.ply", *TRAINING)
    assert Path("t.ply").read_bytes() == own.read_bytes()
    export("--out", "s.ply", "--frame", "capture")
    for way in ("training", "capture", "training"):
        pop.done("export", "s.ply", "--out", "t.ply", "--frame", way, "--overwrite")
        found = frame_of(Path("t.ply"))
        assert found.name == way
        assert psnr("t.ply") == trained
        shutil.copy("t.ply", "s.ply")


def test_coordinates_of_a_map_that_a_file_cannot_hold_are_told_with_the_frame_that_it_can(pop: Pop, own: Path) -> None:
    for place, told in ((5.4e6, True), (5.4, False)):
        transform = np.diag([0.25, 0.25, 0.25, 1.0])
        transform[0, 3] = -0.25 * place
        save_ply("m.ply", load_ply(own), frame=Frame.of_training(transform))
        said = pop.done("export", "m.ply", "--out", "u.ply", "--frame", "capture", "--overwrite").err
        assert ("note: u.ply: the scene is 5.4e+06 from" in said and "steps of 0.5; --frame training" in said) == told


def test_a_ply_that_says_nothing_is_taken_to_be_in_the_capture_s_frame_with_a_note(
    pop, export, psnr, shared_capture, trained
):
    export("--out", "o.ply")
    save_ply("s.ply", load_ply("o.ply"))
    outcome = pop.done("eval", "s.ply", "--capture", shared_capture, "--json", "e.json")
    assert json.loads(Path("e.json").read_text())["psnr"] == trained
    assert "s.ply: does not state its frame, and is taken to be in the capture's own world" in outcome.err
    assert "--training-frame" in outcome.err
    # an explicit frame brings no note
    psnr("s.ply", "--own-frame")
    # what is not known is not made up
    pop.done("export", "s.ply", "--out", "t.ply")
    assert frame_of(Path("t.ply")) is None


def test_a_ply_of_a_trainer_that_moves_the_world_is_read_as_the_command_says(pop, psnr, shared_capture, own, trained):
    save_ply("s.ply", load_ply(own))
    about = ("--capture", shared_capture, "--training-frame")
    assert psnr("s.ply", "--training-frame") == trained
    pop.done("export", "s.ply", "--out", "t.ply", *about, "--frame", "capture")
    assert psnr("t.ply") == trained
    says(pop("eval", "s.ply", *about, "--own-frame"), "--own-frame and --training-frame exclude each other")


def test_another_capture_than_the_one_trained_on_is_refused(pop: Pop, own: Path, capture: Path) -> None:
    (capture / "images" / "view_003.png").unlink()
    shutil.copy(own, "s.ply")
    says(pop("eval", "s.ply", "--capture", capture, "--missing", "skip"), "normalizes differently from toy")


@pytest.mark.parametrize(
    "words", ["", "world", "capture 1 2", "training nan" + 15 * " 0", "training " + 16 * "x ", "training" + 16 * " 1"]
)
def test_a_damaged_comment_is_named(words: str) -> None:
    save_ply("a.ply", many(3), frame=Frame("capture"))
    data = Path("a.ply").read_bytes()
    Path("a.ply").write_bytes(data.replace(b"pop-frame: capture", f"pop-frame: {words}".encode()))
    assert_one_line(lambda: frame_of(Path("a.ply")), "a.ply", "pop-frame:", "damaged")


# Every file that `pop` writes shows in `pop eval`, `render` and `compare` what the run showed that it is of.

# dB that a format may lose of the tiny run, by what the table of formats states; the wrong frame loses ten
LOSES = {"ply": 0.01, "gltf": 0.01, "compressed-ply": 0.2} | dict.fromkeys(
    ("spz", "spz-4", "sog", "splat", "gltf-spz"), 0.1
)


@pytest.fixture(scope="module")
def turned(shared_capture: Path, made_once: Callable[..., Path]) -> Path:
    """The tiny capture in another world."""

    def make(folder: Path) -> None:
        sparse = Path(shutil.copytree(shared_capture, folder / "toy")) / "sparse" / "0"
        model = pycolmap.Reconstruction(sparse)
        rotation = pycolmap.Rotation3d(Rotation.from_rotvec([1.1, -0.7, 2.0]).as_matrix())
        model.transform(pycolmap.Sim3d(3.5, rotation, np.array([40.0, -25.0, 60.0])))
        model.write(sparse)

    return made_once("turned", make) / "toy"


@pytest.fixture(scope="module")
def run(turned: Path, made_once: Callable[..., Path]) -> Path:
    """A result on it, which tests only read."""

    def make(folder: Path) -> None:
        words = ("--out", str(folder / "toy_pop"), *TRAIN, "--steps-scaler", "0.01", "--export", "splat", "sog")
        assert main(["train", str(turned), *words]) == 0

    folder = made_once("run", make) / "toy_pop"
    # the two frames have nothing in common
    transform = np.array(json.loads((folder / "capture.json").read_text())["world_transform"])
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    assert scale < 0.5
    assert np.linalg.norm(transform[:3, 3]) > 1.0
    assert Rotation.from_matrix(transform[:3, :3] / scale).magnitude() > 0.5
    return folder


def stats(run: Path) -> dict[str, Any]:
    """What the run states: its PSNR, and under "encodings" that of every format."""
    path = max((run / "stats").glob("val_step*.json"))
    return json.loads(path.read_text())


def assert_shows_the_same(pop: Pop, file: Path, turned: Path, run: Path, name: str, *words: str) -> None:
    """Hold `eval`, `render` and `compare` of a file to the PSNR of its run."""
    own, about = stats(run)["psnr"], ("--capture", turned, *words)
    outcome = pop.done("eval", file, *about, "--json", "e.json")
    assert ("does not state its frame" in outcome.err) == (name == "splat" and not words)
    measured = json.loads(Path("e.json").read_text())["psnr"]
    assert measured == pytest.approx(own, abs=LOSES[name])
    pop.done("render", file, *about, "--out", "views", "--overwrite")
    listing = json.loads(Path("views/renders.json").read_text())["renders"]
    psnrs = [shown_psnr(Path("views", entry["file"]), turned / "images" / entry["view"]) for entry in listing]
    # pictures are rounded to bytes
    assert float(np.mean(psnrs)) == pytest.approx(measured, abs=0.02)
    outcome = pop.done("compare", run, file, *about, "--markdown")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in outcome.out.splitlines()]
    column = rows[0].index("PSNR")
    assert [row[column] for row in rows[2:]] == [f"{own:.2f}", f"{measured:.2f}"]
    assert rows[3][rows[0].index("method")] == file.name


def shown_psnr(render: Path, photograph: Path) -> float:
    a, b = (cv2.imread(str(path)).astype(np.float64) / 255.0 for path in (render, photograph))
    return float(-10.0 * np.log10(((a - b) ** 2).mean()))


@pytest.mark.parametrize("frame", [(), TRAINING], ids=["capture", "training"])
@pytest.mark.parametrize("name", format_names())
def test_an_export_shows_what_was_trained(pop: Pop, turned: Path, run: Path, name: str, frame: tuple[str, ...]) -> None:
    outcome = pop.done("export", run, "--to", name, *frame)
    (file,) = Path().iterdir()
    # a format without room for the frame says what the commands that read it have to be told
    lost = name == "splat" and bool(frame)
    assert ("--training-frame" in outcome.err) == lost
    assert_shows_the_same(pop, file, turned, run, name, *(["--training-frame"] if lost else []))


@pytest.mark.parametrize("name", format_names())
def test_a_conversion_is_what_is_exported(pop: Pop, run: Path, name: str) -> None:
    files = [Path(default_name(of, name)) for of in ("exported", "converted")]
    pop.done("export", run, "--out", files[0], "--to", name)
    pop.done("export", run, "--out", "a.ply")
    pop.done("convert", "a.ply", files[1], "--to", name)
    exported, converted = map(load_splat_file, files)
    assert (exported.frame, exported.antialiased) == (converted.frame, converted.antialiased)
    assert all(torch.equal(exported.params[key], value) for key, value in converted.params.items())


@pytest.mark.parametrize("name", ["splat", "sog"])
def test_what_a_training_exports_shows_what_the_training_stated(pop: Pop, run: Path, name: str) -> None:
    # in the result's folder it has a run, which is in another frame
    pop.done("eval", run / "export" / f"toy_pop.{name}", "--json", "e.json")
    measured = json.loads(Path("e.json").read_text())["psnr"]
    (stated,) = (entry["psnr"] for entry in stats(run)["encodings"] if entry["format"] == name)
    assert measured == pytest.approx(stated, abs=1e-3)
    assert measured == pytest.approx(stats(run)["psnr"], abs=LOSES[name])


# Which Gaussians go.


def test_opacity_is_compared_activated_and_a_box_keeps_its_faces() -> None:
    params = many(4)
    params["opacities"] = torch.logit(torch.tensor([0.1, 0.5, 0.049, 0.999]))
    assert shrink.opaque_enough(params, 0.05).tolist() == [True, True, False, True]
    assert shrink.opaque_enough(params, 0.0).all()
    means = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.5, 0.0, 0.0], [0.5, 0.5, -0.25]])
    assert shrink.inside(means, (0, 0, 0, 1, 1, 1)).tolist() == [True, True, False, False]
    with pytest.raises(PopError, match="every lower bound must be under"):
        shrink.inside(means, (0, 0, 1, 1, 1, 0))


@given(scores=st.lists(st.integers(0, 5), max_size=20), count=st.integers(0, 25))
def test_the_best_are_those_that_none_left_out_exceeds(scores: list[int], count: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    kept = shrink.best(values, count)
    assert int(kept.sum()) == min(count, len(scores))
    if kept.any() and not kept.all():
        assert values[kept].min() >= values[~kept].max()


@given(
    scores=st.lists(st.floats(0.0, 10.0, width=32), min_size=1, max_size=40),
    each=st.integers(1, 9),
    most=st.integers(0, 400),
)
def test_a_size_is_kept_and_used(scores: list[float], each: int, most: int) -> None:
    values = torch.tensor(scores, dtype=torch.float64)
    sizes: list[int] = []

    def size_of(kept: torch.Tensor) -> int:
        sizes.append(7 + each * int(kept.sum()))
        return sizes[-1]

    if most < 7:
        with pytest.raises(PopError, match="a file without any Gaussian has 7 bytes"):
            shrink.best_within(values, most, size_of)
        return
    kept = shrink.best_within(values, most, size_of)
    size = 7 + each * int(kept.sum())
    assert size <= most
    assert kept.all() or size + each > most or size >= 0.98 * most
    assert len(sizes) <= 14


def test_the_least_that_make_up_a_share_go_and_so_do_the_unseen() -> None:
    scores = torch.tensor([0.0, 1.0, 100.0, 2.0, 897.0])
    assert shrink.all_but_the_least(scores, 0.0).tolist() == [False, True, True, True, True]
    assert shrink.all_but_the_least(scores, 0.002).tolist() == [False, False, True, False, True]


@pytest.mark.parametrize("score", ["contributions", "dominance", "sensitivity"])
def test_what_no_view_shows_scores_nothing(score: shrink.Score) -> None:
    views = [ViewTensors.of(view) for view in tiny_capture().views]
    params = many(30, 0)
    params["means"][:10] = torch.tensor([1e4, 1e4, 1e4])
    found = shrink.view_scores(score, Passes("fast", views), params, 0)
    assert (found[:10] == 0.0).all()
    assert (found[10:] > 0.0).any()
    assert (found >= 0.0).all()


def test_without_a_view_larger_and_more_opaque_is_more_visible() -> None:
    params = many(3)
    params["scales"] = torch.tensor([[-2.0, -2.0, -9.0], [-3.0, -3.0, -9.0], [-2.0, -2.0, -9.0]])
    params["opacities"] = torch.tensor([0.0, 0.0, -4.0])
    assert int(shrink.visibility(params).argmax()) == 0


# What a budget is spent on: bands of colour, bits, Gaussians.


def tuner_of(result: Path, steps: int, degree: int = 3, bands: float = 0.3, own: bool = False) -> compact.Tuner:
    """Return a tuner of a splat with bands that its run did not open, by photographs or by its own pictures."""
    splat = load_splat(result)
    capture, config = open_capture(splat, CaptureOptions())
    drawn = torch.randn(splat.params["shN"].shape, generator=torch.Generator().manual_seed(0))
    params = {**splat.params, "shN": bands * drawn}
    if own:
        capture, config = compact.with_pictures(capture, params, config, degree)
    return compact.Tuner(params, degree, config, capture, {}, steps, lambda *_: None)


def test_colours_of_a_lower_degree_are_fitted_to_what_the_training_views_show(shared_result: Path) -> None:
    tuner = tuner_of(shared_result, 0)
    assert tuner.lowered(3) is tuner.whole
    before = tuner.psnr(tuner.whole)
    cut = {**tuner.whole, "shN": tuner.whole["shN"][:, :0]}
    assert compact.degree_of(tuner.lowered(0)) == 0
    assert abs(tuner.psnr(tuner.lowered(0)) - before) < abs(tuner.psnr(cut) - before)


@pytest.mark.parametrize("name", format_names())
def test_coarser_levels_are_smaller_and_leave_all_but_view_dependence_as_it_is(name: str) -> None:
    files = [encoded(name, many(400), level=level) for level in range(levels(name))]
    sizes = list(map(len, files))
    assert sizes == sorted(sizes, reverse=True)
    if len(sizes) == 1:
        return
    assert sizes[-1] < sizes[0]
    first, last = (FORMATS[name].decode(file, Path("x")) for file in (files[0], files[-1]))
    for field in ("means", "log_scales", "quats", "logits", "sh0"):
        np.testing.assert_array_equal(getattr(first, field), getattr(last, field))
    assert not np.array_equal(first.rest, last.rest)


def test_every_tuning_begins_with_what_the_run_had_learned_of_its_photographs(shared_result: Path) -> None:
    splat = load_splat(shared_result)
    capture, config = open_capture(splat, CaptureOptions())
    config = replace(config, given=None, exposure=True, refine_cameras=True)
    views = [ViewTensors.of(view) for view in capture.train_views(config.test_every)]
    learned = Appearance(config, views).state_dict()
    tuner = compact.Tuner(splat.params, 3, config, capture, learned, 5, lambda *_: None)
    first, second = (tuner.tuned(tuner.whole, 5) for _ in range(2))
    assert all(torch.equal(first[key], value) for key, value in second.items())
    assert same(learned, Appearance(config, views).state_dict())


@pytest.mark.parametrize("steps", [0, 12])
@pytest.mark.parametrize("name", ["spz", "ply"])
def test_a_budget_is_no_worse_than_fewer_gaussians(shared_result: Path, steps: int, name: str) -> None:
    tuner, output = tuner_of(shared_result, steps), Output(name)
    most = len(output.write(tuner.whole)) // 3

    def rows(kept: torch.Tensor) -> dict[str, torch.Tensor]:
        return {key: value[kept] for key, value in tuner.whole.items()}

    scores = shrink.visibility(tuner.whole)
    fewer = rows(shrink.best_within(scores, most, lambda kept: len(output.write(rows(kept)))))
    found = compact.within(tuner, shrink.visibility, most, output)
    assert len(output.write(found.params, found.level)) <= most
    assert tuner.psnr(output.shown(found.params, found.level)) >= tuner.psnr(output.shown(fewer))


def test_bands_that_show_nothing_are_spent_before_gaussians_and_nothing_where_all_fits(shared_result: Path) -> None:
    tuner, output = tuner_of(shared_result, 0, bands=1e-4, own=True), Output("gltf")
    found = compact.within(tuner, shrink.visibility, len(output.write(tuner.whole)) * 4 // 10, output)
    assert found.degree == 0
    assert len(found.params["means"]) == len(tuner.whole["means"])
    tuner, output = tuner_of(shared_result, 50), Output("spz")
    found = compact.within(tuner, shrink.visibility, len(output.write(tuner.whole)), output)
    assert found.level == 0
    assert all(torch.equal(found.params[key], value) for key, value in tuner.whole.items())


@pytest.mark.parametrize("share", [pytest.param(0.6, marks=pytest.mark.slow), 0.4])
@pytest.mark.parametrize("name", typing.get_args(FormatName))
def test_a_size_is_met_in_every_format_and_the_file_shows_what_was_told(
    pop, shared_result, shared_capture, tmp_path, name, share
):
    suffix = ".html" if name == "html" else FORMATS[name].suffix if name in FORMATS else ".ply"
    file = tmp_path / f"x{suffix}"
    words = ("export", shared_result, "--to", name, "--out", file)
    pop.done(*words)
    # most of a tiny page is its script
    whole, script = file.stat().st_size, 27_000 if name == "html" else 0
    most = script + int(share * (whole - script))
    budget = ("--target-mb", f"{most / 1e6:.6f}", "--fine-tune-steps", "8")
    said = pop.done(*words, "--overwrite", *budget).out
    assert file.stat().st_size <= most
    # with fewer bands all of them may fit, and nothing is left to spend on
    assert file.stat().st_size > 0.7 * most or " 461 of 461 Gaussians" in said
    told = re.search(r"PSNR of the file in 1 held-out view: ([0-9.]+) dB", said)
    assert told is not None, said
    if name != "html":
        pop.done("eval", file, "--capture", shared_capture, "--json", tmp_path / "e.json")
        assert f"{json.loads((tmp_path / 'e.json').read_text())['psnr']:.2f}" == told[1]


@pytest.mark.parametrize("name", ["spz", "sog"])
def test_bits_do_not_depend_on_threads(pop: Pop, result: Path, tmp_path: Path, name: str) -> None:
    before, files = contents(result), [tmp_path / f"{threads}.{name}" for threads in (1, 3)]
    for threads, file in zip((1, 3), files, strict=True):
        torch.set_num_threads(threads)
        pop.done("export", result, "--out", file, "--target-mb", "0.012")
    assert files[0].read_bytes() == files[1].read_bytes()
    assert contents(result) == before


def test_a_number_of_gaussians_is_kept_in_tuning(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    words = ("export", shared_result, "--frame", "training", "--max-gaussians", "60", "--out")
    tuner, found = tuner_of(shared_result, 0, degree=0), []
    for steps in (0, 40):
        pop.done(*words, tmp_path / f"{steps}.ply", "--fine-tune-steps", steps)
        params = load_splat_file(tmp_path / f"{steps}.ply").params
        assert len(params["means"]) == 60
        found.append(tuner.psnr({**params, "shN": params["shN"][:, :0]}))
    assert found[1] > found[0]


def test_what_a_box_leaves_out_is_not_grown_back(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    pop.done("export", shared_result, "--out", tmp_path / "whole.ply")
    means = load_splat_file(tmp_path / "whole.ply").params["means"]
    box = [f"{x:.6f}" for share in (0.1, 0.9) for x in means.quantile(share, dim=0).tolist()]
    words = ("--crop", *box, "--target-mb", "0.006", "--fine-tune-steps", "10")
    said = pop.done("export", shared_result, "--out", tmp_path / "box.spz", *words).out
    # the cropped splat is measured by its own pictures, rounded to bytes
    found = re.search(r"PSNR of the file in 1 held-out view: (\S+) dB, of the whole splat (\S+) dB", said)
    assert found is not None, said
    assert float(found[2]) > 50.0
    assert float(found[1]) > 25.0


def test_what_only_a_checkpoint_knows_is_not_guessed(pop: Pop, shared_capture: Path, tmp_path: Path) -> None:
    result = tmp_path / "exposed"
    pop.done("train", shared_capture, "--out", result, *TRAIN, "--exposure", "--skip-sizes")
    small = ("--target-mb", "0.006", "--fine-tune-steps", "4", "--overwrite", "--out", tmp_path / "x.spz")
    untuned = "not fine-tuned: only the checkpoints hold what the run learned of its photographs"
    assert untuned not in pop.done("export", result, *small).out
    lone = result / "ply" / "point_cloud_29.ply"
    assert untuned in pop.done("export", lone, "--capture", shared_capture, *small).out


def test_the_measured_budgets_lose_at_most_half_of_what_fewer_gaussians_alone_lose() -> None:
    captures = json.loads((ROOT / "benchmarks" / "results" / "budgets.json").read_text(encoding="utf-8"))["captures"]
    assert len(captures) >= 4
    for found in captures.values():
        for row in found["rows"]:
            before, after = (found["psnr"] - row[kind]["psnr"] for kind in ("fewer", "tuned"))
            assert after <= 0.5 * before
            assert all(row[kind]["bytes"] <= row["bytes"] for kind in ("fewer", "spent", "tuned"))
