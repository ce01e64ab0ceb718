"""`pop export`: the same splat, in files that other programs open."""

from __future__ import annotations

import ast
import json
import re
import typing
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.faults.ksplat import ksplat_of
from pop_fast.cli.options import FormatName
from pop_fast.data import load_capture
from pop_fast.data.colmap import read_model
from pop_fast.density import shrink
from pop_fast.density.passes import Passes
from pop_fast.errors import PopError
from pop_fast.io.formats import format_names, load_splat_file
from pop_fast.io.ply import Frame, load_ply, save_ply
from pop_fast.train.views import ViewTensors
from tests.app.clouds import many
from tests.app.conftest import Pop
from tests.app.damage import contents, says
from tests.app.tiny import tiny_capture


def exported(pop: Pop, *words: object) -> str:
    outcome = pop.done("export", *words)
    return outcome.out


def psnr(pop: Pop, tmp_path: Path, *words: object) -> float:
    assert pop("eval", *words, "--json", tmp_path / "e.json").status == 0
    return float(json.loads((tmp_path / "e.json").read_text())["psnr"])


def test_the_training_frame_keeps_every_bit(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "t.ply", "--frame", "training")
    assert (tmp_path / "t.ply").read_bytes() == (shared_result / "ply" / "point_cloud_29.ply").read_bytes()


def test_the_frame_is_found_from_the_capture_where_no_record_was_left(pop: Pop, result: Path, tmp_path: Path) -> None:
    exported(pop, result, "--out", tmp_path / "a.ply")
    (result / "capture.json").unlink()
    exported(pop, result, "--out", tmp_path / "b.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_what_no_renderer_shows_is_left_out_and_counted(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    params = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    params["opacities"][:7] = torch.logit(torch.tensor(0.0039))  # just under 1/255 = 0.00392...
    save_ply(tmp_path / "with.ply", params)
    n = len(params["means"])
    said = exported(pop, tmp_path / "with.ply", "--out", tmp_path / "without.ply", "--drop-invisible")
    assert f"{n - 7:,} of {n:,} Gaussians kept, 7 left out" in said
    assert len(load_ply(tmp_path / "without.ply")["means"]) == n - 7
    words = ["--capture", shared_capture]
    assert psnr(pop, tmp_path, tmp_path / "without.ply", *words) == psnr(pop, tmp_path, tmp_path / "with.ply", *words)


def test_inria_s_layout_has_what_its_scripts_read(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "inria", "--layout", "inria")
    own = load_ply(tmp_path / "inria" / "point_cloud" / "iteration_30" / "point_cloud.ply")
    exported(pop, shared_result, "--out", tmp_path / "own.ply")
    for name, value in load_ply(tmp_path / "own.ply").items():
        torch.testing.assert_close(own[name], value)
    renders = sorted((tmp_path / "inria" / "test" / "ours_30" / "renders").iterdir())
    photos = sorted((tmp_path / "inria" / "test" / "ours_30" / "gt").iterdir())
    assert [p.name for p in renders] == [p.name for p in photos] == ["00000.png"]
    photo = cv2.imread(str(shared_capture / "images" / "view_000.png"))
    np.testing.assert_array_equal(cv2.imread(str(photos[0])), photo)
    call = ast.parse((tmp_path / "inria" / "cfg_args").read_text(), mode="eval").body
    assert isinstance(call, ast.Call)
    settings = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    assert settings["source_path"] == str(shared_capture)
    assert settings["white_background"] is False


def test_inria_s_cameras_are_those_of_the_colmap_model(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "inria", "--layout", "inria")
    cameras = json.loads((tmp_path / "inria" / "cameras.json").read_text())
    shots, _ = read_model(shared_capture / "sparse" / "0")
    assert len(cameras) == len(shots) == len(load_capture(shared_capture).views)
    for camera, shot in zip(cameras, shots, strict=True):
        assert camera["img_name"] == Path(shot.name).stem
        np.testing.assert_allclose(camera["rotation"], shot.viewmat[:3, :3].T, atol=1e-9)
        np.testing.assert_allclose(camera["position"], -shot.viewmat[:3, :3].T @ shot.viewmat[:3, 3], atol=1e-9)
        assert camera["fx"] == pytest.approx(shot.camera.focal_length_x)


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ((), "nothing says what to write; give --out FILE or --to FORMAT"),
        (("--out", "x.spz", "--to", "sog"), "ends in .spz, which is not how files of sog end"),
        (("--out", "x.ply", "--to", "html"), "a page ends in .html"),
        (("--out", "x.html", "--frame", "capture"), "a page has no frame of its own"),
        (("--out", "x.ply", "--min-opacity", "1.5"), "--min-opacity 1.5 must be in [0, 1]"),
        (("--out", "x.ply", "--crop", "1", "0", "0", "0", "1", "1"), "each minimum under its maximum"),
        (("--out", "x.ply", "--crop", "91", "91", "91", "99", "99", "99"), "in the box leaves no Gaussian"),
        (("--out", "x.ply", "--final-prune", "1"), "--final-prune 1 must be in [0, 1)"),
        (("--out", "x.ply", "--max-gaussians", "0"), "--max-gaussians 0 must be at least 1"),
        (("--out", "x.ply", "--target-mb", "0"), "--target-mb 0 must be over 0"),
        (("--out", "x.ply", "--target-mb", "0.0001"), "a file without any Gaussian has"),
        (("--out", "x", "--layout", "inria", "--max-gaussians", "5"), "no --to or limits"),
        (("--out", "x.obj"), "must end in one of .compressed.ply, .glb, .ply, .sog, .splat, .spz"),
        (("--out", "there.ply"), "exists; pass --overwrite"),
        (("--out", "full", "--layout", "inria"), "full: holds what this command did not write (notes.txt)"),
        (("--out", "full", "--layout", "inria", "--overwrite"), "did not write (notes.txt)"),
        (("--out", "full.ply", "--overwrite"), "full.ply: a folder of this name is in the way; choose another --out"),
    ],
)
def test_what_cannot_be_exported_is_said_and_nothing_is_written(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], part: str
) -> None:
    (tmp_path / "there.ply").write_text("mine")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    (tmp_path / "full.ply").mkdir()
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    says(pop("export", shared_result, *words), part)
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "there.ply").read_text() == "mine"


def test_an_earlier_export_in_inria_s_layout_is_replaced_only_when_asked(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    words = ["export", shared_result, "--layout", "inria", "--out", tmp_path / "inria"]
    assert pop(*words).status == 0
    before = contents(tmp_path)
    (tmp_path / "inria" / "test" / "ours_30" / "gt" / "00001.png").write_bytes(b"of a longer test set")
    says(pop(*words), "inria: the folder exists and is not empty; choose another or pass --overwrite")
    assert pop(*words, "--overwrite").status == 0
    assert contents(tmp_path) == before


@pytest.mark.parametrize("damage", ["another trainer's", "measured", "no cfg_args"])
def test_an_inria_folder_that_is_not_just_our_export_is_never_replaced(
    pop: Pop, shared_result: Path, tmp_path: Path, damage: str
) -> None:
    words = ["export", shared_result, "--layout", "inria", "--out", tmp_path / "inria"]
    assert pop(*words).status == 0
    settings = tmp_path / "inria" / "cfg_args"
    if damage == "another trainer's":
        settings.write_text(settings.read_text().replace(", exported_by='pop export'", ""))
    elif damage == "measured":
        (tmp_path / "inria" / "results.json").write_text("{}")
    else:
        settings.unlink()
    before = contents(tmp_path)
    said = {"measured": "(results.json)", "no cfg_args": "(cameras.json"}.get(damage, "(cameras.json, cfg_args")
    says(pop(*words, "--overwrite"), "inria: holds what this command did not write", said, "move these files away")
    assert contents(tmp_path) == before


def test_an_export_takes_the_place_of_nothing_that_it_reads(
    pop: Pop, capture: Path, result: Path, tmp_path: Path
) -> None:
    words = ["export", result, "--capture", capture, "--overwrite", "--layout", "inria", "--out"]
    assert pop(*words, tmp_path / "inria").status == 0
    before = contents(tmp_path)
    says(pop(*words, capture), f"{capture}: is read by this command, so it is not replaced")
    says(pop(*words, result), f"{result}: is read by this command, so it is not replaced")
    lone = tmp_path / "inria" / "point_cloud" / "iteration_30" / "point_cloud.ply"
    again = ["export", lone, "--capture", capture, "--own-frame", "--overwrite"]
    says(
        pop(*again, "--layout", "inria", "--out", tmp_path / "inria"), "inria: holds", "point_cloud.ply, which is read"
    )
    says(pop(*again, "--out", lone), "point_cloud.ply: is the splat that is read; choose another --out")
    assert contents(tmp_path) == before


# `pop export --to`, `pop convert`, and the options that make files smaller, as a user meets them.


def test_the_options_name_every_format() -> None:
    assert set(typing.get_args(FormatName)) == {*format_names(), "html"}


def test_no_two_formats_share_a_name_that_nobody_chose(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = typing.get_args(FormatName)
    for name in names:
        exported(pop, shared_result, "--to", name)
    assert len(list(tmp_path.iterdir())) == len(names)
    for path in tmp_path.iterdir():
        assert path.suffix == ".html" or len(load_splat_file(path).params["means"]) > 0


def test_a_conversion_writes_a_page_too(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "a.ply")
    outcome = pop.done("convert", tmp_path / "a.ply", tmp_path / "b.html")
    size = (tmp_path / "b.html").stat().st_size
    assert f"Gaussians, {size / 1e6:.2f} MB -> {tmp_path / 'b.html'}" in outcome.out
    assert (tmp_path / "b.html").read_text().startswith("<!doctype html>")


def test_a_box_is_in_the_frame_of_the_capture_in_a_conversion_too(
    pop: Pop, shared_result: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "own.ply")
    exported(pop, shared_result, "--out", tmp_path / "t.ply", "--frame", "training")
    own = load_ply(tmp_path / "own.ply")["means"]
    box = [f"{value:.6f}" for value in (*own.quantile(0.2, dim=0).tolist(), *own.quantile(0.9, dim=0).tolist())]
    for name in ("own", "t"):
        words = (tmp_path / f"{name}.ply", tmp_path / f"{name}_box.ply", "--crop", *box)
        assert pop("convert", *words).status == 0
    assert 0 < len(load_ply(tmp_path / "own_box.ply")["means"]) < len(own)
    assert len(load_ply(tmp_path / "own_box.ply")["means"]) == len(load_ply(tmp_path / "t_box.ply")["means"])


def test_limits_are_applied_one_after_the_other_and_said(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    said = exported(
        pop, shared_result, "--out", tmp_path / "x.ply", "--min-opacity", "0.0039", "--final-prune", "0.003",
        "--max-gaussians", n // 2,
    )  # fmt: skip
    assert f"opacity >= 0.0039: {n:,} of {n:,} Gaussians kept" in said
    assert "all but 0.30% of the blending weights: " in said
    assert f"highest sensitivity: {n // 2:,} of" in said
    assert len(load_ply(tmp_path / "x.ply")["means"]) == n // 2


def test_a_box_is_in_the_frame_of_the_capture(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "whole.ply")
    whole = load_ply(tmp_path / "whole.ply")["means"]
    low, high = whole.quantile(0.2, dim=0), whole.quantile(0.9, dim=0)
    box = [f"{value:.6f}" for value in (*low.tolist(), *high.tolist())]
    low, high = torch.tensor([float(value) for value in box]).split(3)
    exported(pop, shared_result, "--out", tmp_path / "box.ply", "--crop", *box)
    kept = load_ply(tmp_path / "box.ply")["means"]
    assert 0 < len(kept) < len(whole)
    assert ((kept >= low - 1e-5) & (kept <= high + 1e-5)).all()
    assert len(kept) == int(((whole >= low) & (whole <= high)).all(1).sum())


@pytest.mark.parametrize("share", [0.6, 0.4])
@pytest.mark.parametrize("name", typing.get_args(FormatName))
def test_a_size_is_met_in_every_format_and_the_file_shows_what_was_told(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str,
    share: float,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    exported(pop, shared_result, "--to", name)
    (file,) = tmp_path.iterdir()
    # most of a tiny page is its script
    whole, script = file.stat().st_size, 27_000 if name == "html" else 0
    most = script + int(share * (whole - script))
    budget = ("--target-mb", f"{most / 1e6:.6f}", "--fine-tune-steps", "8")
    said = exported(pop, shared_result, "--to", name, "--overwrite", *budget)
    assert file.stat().st_size <= most
    # with fewer bands all of them may fit, and nothing is left to spend on
    assert file.stat().st_size > 0.7 * most or " 461 of 461 Gaussians" in said
    told = re.search(r"PSNR of the file in 1 held-out views: ([0-9.]+) dB", said)
    assert told is not None, said
    if name != "html":
        assert f"{psnr(pop, tmp_path, file, '--capture', shared_capture):.2f}" == told[1]


def test_scores_of_views_need_a_capture(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "a.ply")
    said = exported(pop, tmp_path / "a.ply", "--out", tmp_path / "b.spz", "--max-gaussians", "20")
    assert "highest visibility: 20 of" in said
    says(
        pop("export", tmp_path / "a.ply", "--out", tmp_path / "c.spz", "--final-prune", "0.01"),
        "contributions is summed over the training views; give --capture DIR",
    )


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("gone.ply", "b.spz"), "gone.ply: the PLY file is absent"),
        (("gone.sog", "b.spz"), "gone.sog: the file is absent"),
        (("a.ply", "b.obj"), "must end in one of"),
        (("a.ply", "a.ply"), "is the splat that is read"),
        (("a.ply", "there.spz"), "exists; pass --overwrite"),
        (("a.ply", "b.html", "--to", "sog"), "a page ends in .html, and --to sog was asked for"),
        (("a.ply", "b.ksplat"), "b.ksplat: is of a format that is read and not written"),
        (("a.ply", "meta.json"), "meta.json: is of a format that is read and not written"),
        (("t.ply", "b.spz", "--crop", "0", "0", "0", "1", "1", "1"), "t.ply: is in a training frame"),
        (("a.ply", "b.spz", "--score", "dominance"), "needs the training views"),
        (("empty.spz", "b.ply"), "empty.spz: is cut off in its header"),
        (("empty.splat2", "b.ply"), "must end in one of"),
        ((".", "b.ply"), "is a folder without SOG's meta.json; 'pop export' reads the folder of a training"),
    ],
)
def test_what_cannot_be_converted_is_said(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    exported(pop, shared_result, "--out", "a.ply")
    save_ply("t.ply", load_ply("a.ply"), frame=Frame("training"))
    for file in ("there.spz", "empty.spz"):
        Path(file).touch()
    says(pop("convert", *words), part)
    assert not Path("b.ply").exists()


def test_sog_in_a_folder_and_ksplat_are_converted_and_drawn(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    exported(pop, shared_result, "--out", tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "folder")
    (tmp_path / "a.ksplat").write_bytes(ksplat_of(load_splat_file(tmp_path / "a.sog").params, 0))
    of_sog = psnr(pop, tmp_path, tmp_path / "a.sog", "--capture", shared_capture)
    for source in ("folder", "folder/meta.json", "a.ksplat"):
        out = tmp_path / f"{source.replace('/', '_')}.ply"
        pop.done("convert", tmp_path / source, out)
        for file in (tmp_path / source, out):
            assert abs(psnr(pop, tmp_path, file, "--capture", shared_capture) - of_sog) < 0.01, file


# Fewer Gaussians in a file: which go, and how far down a size is met.


def test_opacity_is_compared_activated() -> None:
    params = many(4)
    params["opacities"] = torch.logit(torch.tensor([0.1, 0.5, 0.049, 0.999]))
    assert shrink.opaque_enough(params, 0.05).tolist() == [True, True, False, True]
    assert shrink.opaque_enough(params, 0.0).all()


def test_a_box_keeps_what_lies_in_it_or_on_its_faces() -> None:
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
    capture = tiny_capture()
    views = [ViewTensors.of(view) for view in capture.views]
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
    assert shrink.visibility(params).argsort(descending=True).tolist()[0] == 0
