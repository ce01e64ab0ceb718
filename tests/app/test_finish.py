"""What `pop train` writes when the last step is taken: exports, the viewer's page, the table of sizes, the report."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from pop_fast.cli.finish import table_lines
from pop_fast.io.formats import format_names, load_splat_file
from pop_fast.io.ply import load_ply
from tests.app.browser import browser
from tests.app.conftest import TRAIN, Pop

LAST = "stats/val_step0029.json"


def again(pop: Pop, result: Path, capture: Path, *words: object) -> str:
    """Finish a finished run again."""
    outcome = pop("train", capture, "--out", result, *TRAIN, "--resume", *words)
    assert outcome.status == 0, outcome.err
    return outcome.out


def test_a_run_ends_with_its_size_in_every_format(shared_result: Path) -> None:
    entries = json.loads((shared_result / LAST).read_text())["encodings"]
    assert [entry["format"] for entry in entries] == list(format_names())
    by_name = {entry["format"]: entry for entry in entries}
    n = len(load_ply(shared_result / "ply" / "point_cloud_29.ply")["means"])
    assert {entry["num_gaussians"] for entry in entries} == {n}
    assert 248 * n < by_name["ply"]["bytes"] < 248 * n + 3000
    assert by_name["splat"]["bytes"] == 32 * n
    assert by_name["spz"]["bytes"] < by_name["ply"]["bytes"] / 5
    # what comes back from glTF is what went in; of the others little is lost
    assert by_name["gltf"]["psnr"] == pytest.approx(by_name["ply"]["psnr"], abs=1e-3)
    for name in ("spz", "sog", "compressed-ply"):
        assert by_name[name]["psnr"] == pytest.approx(by_name["ply"]["psnr"], abs=0.2)
    psnr = json.loads((shared_result / LAST).read_text())["psnr"]
    assert by_name["ply"]["views"] == 1
    assert by_name["ply"]["psnr"] == pytest.approx(psnr, abs=1e-3)


def test_the_table_is_printed_and_the_report_shows_it(pop: Pop, result: Path, shared_capture: Path) -> None:
    said = again(pop, result, shared_capture)
    lines = said.splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("format "))
    assert [line.split()[0] for line in lines[head + 1 : head + 1 + len(format_names())]] == list(format_names())
    page = (result / "report.html").read_text()
    assert "<h2>Files</h2>" in page
    assert all(f"<td>{name}</td>" in page for name in format_names())
    assert '<iframe class="viewer"' in page


def test_exports_are_written_with_the_limits_that_are_asked_for(pop: Pop, result: Path, shared_capture: Path) -> None:
    words = ("--export", "spz", "gltf-spz", "html", "--max-gaussians", "100", "--skip-sizes")
    said = again(pop, result, shared_capture, *words)
    assert "highest sensitivity: 100 of" in said
    assert "format " not in said
    names = sorted(path.name for path in (result / "export").iterdir())
    assert names == ["result-spz.glb", "result.html", "result.spz"]
    assert len(load_splat_file(result / "export" / "result.spz")[0]["means"]) == 100
    # what was trained stays whole
    assert len(load_ply(result / "ply" / "point_cloud_29.ply")["means"]) > 100


def test_limits_without_a_format_make_a_ply_in_the_frame_of_the_capture(
    pop: Pop, result: Path, shared_capture: Path, tmp_path: Path
) -> None:
    again(pop, result, shared_capture, "--final-prune", "0", "--min-opacity", "0", "--skip-sizes")
    assert pop("export", result, "--out", tmp_path / "whole.ply").status == 0
    kept = load_ply(result / "export" / "result.ply")["means"]
    whole = load_ply(tmp_path / "whole.ply")["means"]
    rows = {tuple(row) for row in whole.tolist()}
    assert all(tuple(row) in rows for row in kept.tolist())


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--target-mb", "-1"), "--target-mb -1 must be over 0"),
        (("--final-prune", "2"), "--final-prune 2 must be in [0, 1)"),
    ],
)
def test_a_limit_that_cannot_be_is_said_before_training(
    pop: Pop, shared_capture: Path, tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    outcome = pop("train", shared_capture, "--out", tmp_path / "new", *TRAIN, *words)
    assert outcome.status == 2
    assert said in outcome.err
    assert not (tmp_path / "new").exists()


def test_an_export_that_cannot_be_written_leaves_the_results_and_says_so(
    pop: Pop, result: Path, shared_capture: Path
) -> None:
    outcome = pop(
        "train", shared_capture, "--out", result, *TRAIN, "--resume", "--export", "spz", "--target-mb", "1e-5"
    )
    assert outcome.status == 1
    assert "a file without any Gaussian has" in outcome.err
    assert f"the results in {result} are complete" in outcome.err
    assert not (result / "export").exists()


def test_a_new_run_replaces_the_page_and_the_exports_of_the_old_one(
    pop: Pop, result: Path, shared_capture: Path
) -> None:
    again(pop, result, shared_capture, "--export", "spz", "--skip-sizes")
    assert (result / "export" / "result.spz").is_file()
    outcome = pop("train", shared_capture, "--out", result, *TRAIN, "--overwrite")
    assert outcome.status == 0, outcome.err
    assert not (result / "export").exists()
    assert (result / "viewer.html").is_file()


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
    outcome = pop("report", result)
    assert outcome.status == 2
    assert said in outcome.err


def test_a_result_from_before_there_was_a_page_has_a_report(pop: Pop, result: Path) -> None:
    stats = json.loads((result / LAST).read_text())
    del stats["encodings"]
    (result / LAST).write_text(json.dumps(stats))
    (result / "viewer.html").unlink()
    assert pop("report", result).status == 0
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


def test_a_viewer_whose_script_is_not_of_this_version_is_linked(pop: Pop, result: Path) -> None:
    viewer = result / "viewer.html"
    viewer.write_text(viewer.read_text().replace("</script></body>", "window.other = 1</script></body>"))
    # the same text and more is another script
    assert pop("report", result).status == 0
    assert 'in <a href="viewer.html">viewer.html</a>' in (result / "report.html").read_text()
    assert "<iframe" not in (result / "report.html").read_text()


def test_a_table_has_its_first_column_to_the_left() -> None:
    assert table_lines([("a", "bb"), ("ccc", "d")]) == ["a    bb", "ccc   d"]
