"""`pop export --to`, `pop convert`, and the options that make files smaller, as a user meets them."""

from __future__ import annotations

import json
import typing
from pathlib import Path

import pytest
import torch

from pop_fast.cli.limits import FormatName
from pop_fast.io.formats import FORMATS, default_name, format_names, load_splat_file
from pop_fast.io.ply import Frame, load_ply, save_ply
from tests.app.conftest import Pop


def exported(pop: Pop, *words: object) -> str:
    outcome = pop("export", *words)
    assert outcome.status == 0, outcome.err
    return outcome.out


def test_the_options_name_every_format() -> None:
    assert set(typing.get_args(FormatName)) == {*format_names(), "html"}


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_shows_in_the_training_frame_what_was_trained(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    said = exported(pop, shared_result, "--to", name, "--frame", "training")
    path = tmp_path / default_name("toy_pop", name)
    assert f"-> {path.name}" in said
    params = load_splat_file(path).params
    trained = load_ply(shared_result / "ply" / "point_cloud_29.ply")
    assert len(params["means"]) == len(trained["means"])
    torch.testing.assert_close(params["means"].mean(0), trained["means"].mean(0), atol=0.01, rtol=0.0)


def test_an_export_can_be_measured_and_is_as_good(
    pop: Pop, shared_result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    values = {}
    for file in ("a.ply", "a.spz", "a.sog", "a.glb"):
        exported(pop, shared_result, "--out", tmp_path / file)
        words = ("--capture", shared_capture, "--own-frame", "--json", tmp_path / "e.json")
        assert pop("eval", tmp_path / file, *words).status == 0
        values[file] = json.loads((tmp_path / "e.json").read_text())["psnr"]
    assert values["a.glb"] == pytest.approx(values["a.ply"], abs=1e-3)
    assert values["a.spz"] == pytest.approx(values["a.ply"], abs=0.1)
    assert values["a.sog"] == pytest.approx(values["a.ply"], abs=0.1)


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
    outcome = pop("convert", tmp_path / "a.ply", tmp_path / "b.html")
    assert outcome.status == 0, outcome.err
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


@pytest.mark.parametrize("file", ["x.spz", "x.sog", "x.ply"])
def test_a_size_is_met(pop: Pop, shared_result: Path, tmp_path: Path, file: str) -> None:
    exported(pop, shared_result, "--out", tmp_path / f"whole-{file}")
    whole = (tmp_path / f"whole-{file}").stat().st_size
    said = exported(pop, shared_result, "--out", tmp_path / file, "--target-mb", f"{0.6 * whole / 1e6:.6f}")
    assert "highest sensitivity in " in said
    assert 0.4 * whole < (tmp_path / file).stat().st_size <= 0.6 * whole


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
    ],
)
def test_what_cannot_be_exported_is_said_and_nothing_is_written(
    pop: Pop, shared_result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], part: str
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = pop("export", shared_result, *words)
    assert outcome.status == 2
    assert part in outcome.err
    assert not list(tmp_path.iterdir())


def test_scores_of_views_need_a_capture(pop: Pop, shared_result: Path, tmp_path: Path) -> None:
    exported(pop, shared_result, "--out", tmp_path / "a.ply")
    said = exported(pop, tmp_path / "a.ply", "--out", tmp_path / "b.spz", "--max-gaussians", "20")
    assert "highest visibility: 20 of" in said
    outcome = pop("export", tmp_path / "a.ply", "--out", tmp_path / "c.spz", "--final-prune", "0.01")
    assert outcome.status == 2
    assert "contributions is summed over the training views; give --capture DIR" in outcome.err


@pytest.mark.parametrize("name", format_names())
def test_a_file_is_converted_to_every_format_and_back(pop: Pop, shared_result: Path, tmp_path: Path, name: str) -> None:
    exported(pop, shared_result, "--out", tmp_path / "a.ply")
    middle = tmp_path / ("m.ply" if name == "ply" else f"m{FORMATS[name].suffix}")
    assert pop("convert", tmp_path / "a.ply", middle, "--to", name).status == 0
    outcome = pop("convert", middle, tmp_path / "b.ply")
    assert outcome.status == 0, outcome.err
    n = len(load_ply(tmp_path / "a.ply")["means"])
    assert f"{n:,} Gaussians" in outcome.out
    was, now = load_ply(tmp_path / "a.ply")["means"], load_ply(tmp_path / "b.ply")["means"]
    torch.testing.assert_close(was.sort(0).values, now.sort(0).values, atol=0.02, rtol=0.01)


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
    outcome = pop("convert", *words)
    assert outcome.status == 2
    assert part in outcome.err
    assert not Path("b.ply").exists()
