"""The figures: their numbers are the results', what was not run is said, and the files are what they claim to be."""

from __future__ import annotations

import csv
import hashlib
import itertools
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from paper_repro import figures
from paper_repro.claims import SWEEP, claims
from paper_repro.cli import main
from paper_repro.collect import file_hash
from paper_repro.figures import FIGURES, artifact, curves, qualitative, style
from paper_repro.figures.data import NoDataError, choose, curve_of
from paper_repro.figures.style import foot, save
from paper_repro.figures.tradeoffs import Marker, along, places
from paper_repro.jobs import job_named, load_rows
from paper_repro.paper import paper
from paper_repro.results import BINS, RESULTS, UNTIMED, Result, write
from paper_repro.train_row import Options, capture_folder, load_capture_of
from pop_fast.errors import PopError
from tests.repro.made import PLAIN, asked, curve, drawn, lines, result, texts

ROOT = Path(__file__).parents[2]
METHODS = ("3dgs", "gsplat", "pup", "mini_splatting", "taming", "speedy_splat", "pop")
OF_RESULTS = ("1", "2", "4a", "4b", "6a", "6b", "7")
STEPS = {"max_steps": 10_000}


def histogram(**counts: int) -> tuple[int, ...]:
    """Make a histogram with counts in a few bins, named as b0 to b49."""
    return tuple(counts.get(f"b{i}", 0) for i in range(BINS))


def logged(n: int, steps: int = 10_000, **more: float) -> tuple:
    """Make a curve of three points: `n` Gaussians at the start, twice and three times as many later."""
    points = {0: n, steps // 2: 2 * n, steps - 1: 3 * n}
    columns = {name: [value, value / 2, value / 4] for name, value in more.items()}
    return curve(points, **columns)


def full() -> list[Result]:
    """Make results of every row on two scenes, each with its own numbers."""
    found = []
    for i, row in enumerate(load_rows()):
        for j, scene in enumerate(("fox", "bear_512")):
            n = 1200 * (i + 1) + 120 * j
            points = logged(
                *(n // 3, 13_333 if row.name == "pup" else 10_000),
                grad_l1=1.0,
                grad_l2=0.25,
                grad_ssim=0.125,
                probe_blended=8.0 + i,
                probe_traversed=64.0 + i + j,
            )
            told = {
                "curve": points,
                "psnr": 20.0 + i / 4 + j,
                "seconds": {"load": 1.0, "train": 10.0 + i, "evaluate": 1.0},
            }
            length = {"max_steps": 13_333 if row.name == "pup" else 10_000}
            found.append(result(row.name, scene, n=n, schedule=length, **told))
    return found


@pytest.fixture(scope="module")
def written(made_once):
    """The figures that need results alone, drawn by the command from files."""

    def make(folder: Path) -> None:
        for one in full():
            write(one, folder / "results")
        for figure in OF_RESULTS:
            words = ["figure", figure, "--scale", "small", "--results", folder / "results", "--out", folder / "out"]
            assert main([str(word) for word in words]) == 0

    return made_once("figures", make)


@pytest.mark.parametrize("figure", OF_RESULTS)
def test_a_figure_is_an_svg_a_png_and_a_table(written, figure):
    stem = written / "out" / f"figure_{figure}"
    root = ET.parse(stem.with_suffix(".svg")).getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert root.attrib["width"] == f"{72 * style.COLUMN:g}pt"
    assert len(root.findall(".//{http://www.w3.org/2000/svg}path")) > 20
    png = stem.with_suffix(".png").read_bytes()
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    # a pixel is a 300th of an inch in print
    assert int.from_bytes(png[16:20], "big") == round(300 * style.COLUMN)
    with stem.with_suffix(".csv").open(encoding="utf-8") as file:
        found = list(csv.reader(file))
    assert len(found) > 1
    assert {len(row) for row in found} == {len(found[0])}


def test_the_same_results_are_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        save_as = tmp_path / name / "figure_7"
        save_as.parent.mkdir()
        with style.look():
            save(drawn("7", full()), save_as)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()


def test_curves_in_the_table_are_the_means_of_the_results(written):
    with (written / "out" / "figure_7.csv").open(encoding="utf-8") as file:
        found = {(line["row"], int(line["step"])): line for line in csv.DictReader(file)}
    results = {(r.row, r.scene): r for r in full()}
    assert {row for row, _ in found} == set(METHODS)
    for (row, step), line in found.items():
        of_row = [results[row, scene] for scene in ("fox", "bear_512")]
        counts = [next(p["num_gaussians"] for p in r.curve if p["step"] == step) for r in of_row]
        assert float(line["value"]) == sum(counts) / 2
        assert line["runs"].split() == [r.run for r in of_row]
        assert line["scenes"] == "fox bear_512"
    # PUP-3DGS continues when the others have ended
    assert max(step for row, step in found if row == "pup") == 13_332
    assert max(step for row, step in found if row == "gsplat") == 9_999


def test_gradients_are_those_of_pop_on_one_scene():
    made = lines(drawn("4a", full()))
    assert {(line["row"], line["scenes"]) for line in made} == {("pop", "fox")}
    assert [line["value"] for line in made if line["quantity"] == "grad_l2"] == [0.25, 0.125, 0.0625]
    assert [line["step"] for line in made if line["quantity"] == "grad_ssim"] == [0, 5_000, 9_999]


def test_gaussians_per_pixel_are_of_the_probed_views_and_else_of_the_held_out_ones():
    made = drawn("4b", full())
    of_pop = [r for r in full() if r.row == "pop"]
    means = [sum(r.curve[i]["probe_traversed"] for r in of_pop) / 2 for i in range(3)]
    assert [x["value"] for x in lines(made) if (x["row"], x["quantity"]) == ("pop", "probe_traversed")] == means
    assert "three training views" in texts(made)
    older = [
        result(row, curve=logged(100, n_blended=8.0, n_traversed=32.0, psnr_test=20.0), schedule=STEPS)
        for row in ("3dgs", "pop")
    ]
    # what a record of one training view says does not count
    alone = {"step": 3, "num_gaussians": 100, "n_blended": 99.0, "n_traversed": 99.0, "psnr_test": None}
    older = [replace(r, curve=(r.curve[0], alone, *r.curve[1:])) for r in older]
    made = drawn("4b", older)
    assert "the held-out views" in texts(made)
    assert [x["value"] for x in lines(made) if (x["row"], x["quantity"]) == ("pop", "n_blended")] == [8.0, 4.0, 2.0]


def test_figure_1_has_every_run_and_the_means_in_markers_as_large_as_their_numbers():
    made = drawn("1", full())
    means = {line["row"]: line for line in lines(made) if line["scene"] == "mean"}
    runs = {(line["row"], line["scene"]): line for line in lines(made) if line["scene"] != "mean"}
    assert (len(means), len(runs)) == (9, 18)
    for one in full():
        if one.row in means:
            line = runs[one.row, one.scene]
            told = (line["run"], line["seconds"], line["psnr"], line["num_gaussians"])
            assert told == (one.run, one.training_seconds, one.psnr, one.num_gaussians)
    for row, line in means.items():
        assert line["psnr"] == sum(runs[row, scene]["psnr"] for scene in ("fox", "bear_512")) / 2
        assert line["num_gaussians"] == sum(runs[row, s]["num_gaussians"] for s in ("fox", "bear_512")) / 2
    sizes = sorted(s for s in (float(c.get_sizes()[0]) for c in made.figure.axes[0].collections) if s > 2.0)
    counts = sorted(line["num_gaussians"] for line in means.values())
    assert sizes == pytest.approx([max(sizes) * n / counts[-1] for n in counts], rel=1e-12)


def test_seeds_that_were_not_timed_beside_the_others_count_for_psnr_and_gaussians_of_figure_1():
    beside = {"protocol": {**PLAIN.protocol, "timing": f"training loop{UNTIMED}"}}
    slow = {"seconds": {"load": 1.0, "train": 900.0, "evaluate": 2.0, "cpu": 900.0}}
    runs = [
        result("pop", n=1000, psnr=30.0),
        result("pop", seed=43, n=3000, psnr=33.0, cpu="another kind", **slow),
        result("pop", seed=44, n=2000, psnr=30.0, **beside, **slow),
    ]
    made = drawn("1", runs)
    *each, mean = lines(made)
    assert (mean["seconds"], mean["psnr"], mean["num_gaussians"]) == (100.0, 31.0, 2000.0)
    assert [line["seconds"] for line in each] == [100.0, "", ""]
    assert "Time on a machine (a kind), native, 1 thread, of the runs there alone." in texts(made)


@pytest.mark.parametrize("figure", OF_RESULTS)
def test_all_that_a_figure_writes_lies_inside_of_it(figure):
    # with two digits behind the point on every axis of figure 6b
    few = [result("l2", scene, n=1000, psnr=29.28) for scene in ("fox", "bear_512", "garden_512", "bonsai_800")]
    for results in (full(), *([few] if figure == "6b" else [])):
        with style.look():
            made = drawn(figure, results).figure
            made.set_dpi(style.SAVED_DPI)
            box = made.get_tightbbox()
        assert box.x0 >= 0.0, box
        assert box.y0 >= 0.0, box
        assert box.x1 <= made.get_figwidth(), box
        assert box.y1 <= made.get_figheight(), box


def test_figure_6b_has_every_run_in_the_panel_of_its_capture_and_no_mean_over_captures():
    made = drawn("6b", full())
    told = lines(made)
    assert {line["scene"] for line in told} == {"fox", "bear_512"}
    runs = {(line["row"], line["scene"]): line for line in told if line["run"] and line["psnr"] != ""}
    assert len(runs) == 16
    for one in full():
        if (one.row, one.scene) in runs:
            line = runs[one.row, one.scene]
            assert (line["run"], line["psnr"], line["num_gaussians"]) == (one.run, one.psnr, one.num_gaussians)
    assert [axes.get_title(loc="left").partition(":")[0] for axes in made.figure.axes] == ["fox", "bear_512"]
    scenes = ("fox", "bear_512", "garden_512", "bonsai_800")
    four = [replace(r, scene=scene) for r in full() for scene in scenes if r.scene == "fox"]
    assert len(drawn("6b", four).figure.axes) == 4
    # of L2 alone there is no panel, and the note says what was not run there
    (lone,) = drawn("6b", [r for r in full() if r.scene == "fox" or r.row == "l2"]).figure.axes
    assert lone.get_title(loc="left").startswith("fox: ")


@given(
    offsets=st.lists(st.sampled_from((-2.0, -0.3, -0.01, 0.01, 0.3, 2.0)), min_size=1, max_size=3),
    seeds=st.integers(1, 3),
    order=st.permutations(range(7)),
    counts=st.lists(st.integers(1, 200), min_size=7, max_size=7, unique=True),
    place=st.floats(0.01, 0.99),
)
@settings(max_examples=12)
def test_the_star_of_figure_6b_lies_on_that_side_of_the_curve_that_the_claim_says(offsets, seeds, order, counts, place):
    scenes = ("fox", "bear_512", "garden_512")[: len(offsets)]
    found, expected = [], {}
    for scene, offset in zip(scenes, offsets, strict=True):
        # counts need not fall with the divisor, and a seed differs by 0.02 dB and a Gaussian
        each = {row: (2_000 * counts[k], 25.0 + 0.5 * k) for row, k in zip(SWEEP, order, strict=True)}
        x, y = zip(*sorted((np.log(n), psnr) for n, psnr in each.values()), strict=True)
        n = round(float(np.exp(x[0] + place * (x[-1] - x[0]))))
        each["l2"] = (n, float(np.interp(np.log(n), x, y)) + offset)
        expected[scene] = offset
        found += [
            result(row, scene, seed=42 + i, n=n + i, psnr=psnr + 0.02 * (i - (seeds - 1) / 2))
            for row, (n, psnr) in each.items()
            for i in range(seeds)
        ]
    made = drawn("6b", found)
    verdicts = {e.scene: e for c in claims("small", found) if c.id == "l2" for e in c.told.evidence}
    for axes, scene in zip(made.figure.axes, scenes, strict=True):
        curve_drawn = axes.transData.transform(np.column_stack(axes.lines[0].get_data()))
        star = axes.transData.transform(axes.collections[-1].get_offsets())[0]
        above = star[1] - np.interp(star[0], curve_drawn[:, 0], curve_drawn[:, 1])
        told = re.search(r"L2 less L1 / n ([+-]\d+\.\d\d)", axes.get_title(loc="left"))
        if abs(float(told[1])) > 0.05:
            assert (above > 0.0) == (float(told[1]) > 0.0), scene
        verdict = verdicts[scene].verdict
        assert axes.get_title(loc="left").endswith(verdict)
        if verdict != "not decided":
            assert (above > 0.0) == (verdict == "holds")
        if seeds == 1:
            assert verdict == "not decided"
        elif abs(expected[scene]) > 1.0:
            assert verdict == ("holds" if expected[scene] > 0.0 else "does not hold")


def test_the_marked_shares_are_those_of_the_histogram():
    # edges belong to the bin above them: 0.1 opens b5, 0.9 opens b45
    counts = histogram(b0=30, b4=70, b5=500, b44=150, b45=200, b49=50)
    kitchen = result("3dgs", "kitchen", n=1000, opacity_histogram=counts, schedule=STEPS, scale="paper")
    made = drawn("2", [kitchen], scale="paper")
    shares = {line["what"]: line["share"] for line in lines(made) if line["what"] != "bin"}
    assert shares["ours under 0.1"] == pytest.approx(0.1, rel=1e-12)
    assert shares["ours over 0.9"] == pytest.approx(0.25, rel=1e-12)
    assert (shares["paper under 0.1"], shares["paper over 0.9"]) == (0.337, 0.199)
    bins = [line["share"] for line in lines(made) if line["what"] == "bin"]
    assert bins == pytest.approx([count / 1000 for count in counts], rel=1e-12)
    said = texts(made)
    for text in ("10.0 % under 0.1", "25.0 % over 0.9", "paper: 33.7 %", "paper: 19.9 %"):
        assert text in said
    # with another capture stands no number of the paper's
    other = drawn("2", [result("3dgs", n=1000, opacity_histogram=counts, schedule=STEPS)])
    assert "paper:" not in texts(other)
    assert "The paper's figure is of another capture, kitchen." in texts(other)
    assert {line["what"] for line in lines(other)} == {"bin", "ours under 0.1", "ours over 0.9"}
    with pytest.raises(ValueError, match=r"edge is 0\.15; it must lie between two of 50 bins"):
        curves.share_below(np.ones(BINS), 0.15)


def test_seeds_count_the_same_in_the_histogram():
    runs = [
        result("3dgs", seed=1, n=10, opacity_histogram=histogram(b0=10), schedule=STEPS),
        result("3dgs", seed=2, n=1000, opacity_histogram=histogram(b49=1000), schedule=STEPS),
    ]
    shares = {line["what"]: line["share"] for line in lines(drawn("2", runs))}
    assert (shares["ours under 0.1"], shares["ours over 0.9"]) == (0.5, 0.5)


@pytest.mark.parametrize("figure", OF_RESULTS)
def test_a_figure_without_results_says_what_was_not_run(figure, tmp_path, capsys):
    words = ["figure", figure, "--scale", "small", "--results", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(words) == 1
    said = capsys.readouterr().err
    assert f"figure {figure} at scale small is not drawn: not run are " in said
    assert "pop-repro queue --scale small --data DATA --rows " in said
    assert not (tmp_path / "out").exists()


def test_results_without_the_curve_that_is_shown_are_named():
    with pytest.raises(NoDataError, match="the results of pop have no curve of what it shows; remove them and train"):
        drawn("4a", [result("pop", schedule=STEPS)])


def test_rows_that_were_not_run_are_named_below_the_figure():
    some = [r for r in full() if r.row in ("pop", "gsplat")]
    made = drawn("7", some)
    said = texts(made)
    assert "Not run: 3DGS, PUP-3DGS, Mini-Splatting, Taming-3DGS and Speedy-Splat." in said
    assert {line["row"] for line in lines(made)} == {"gsplat", "pop"}


def test_the_note_says_captures_steps_seeds_and_whether_it_is_the_protocol():
    runs = [result("pop", seed=seed, schedule=STEPS) for seed in (42, 43)]
    chosen = choose(asked("7", runs), ["pop"], ["fox"])
    said = foot(asked("7", runs), chosen)
    assert said.replace("\N{NO-BREAK SPACE}", " ") == (
        "Capture fox (270 × 480); 10,000 steps; mean over seeds 42 and 43. Scale small, not the paper's protocol: real "
        "photographs for a CPU: the whole schedule, small images, theta_blur at least 10 pixels."
    )
    of_rows = [*runs, result("gsplat", seed=44, schedule=STEPS)]
    said = foot(asked("7", of_rows), choose(asked("7", of_rows), ["pop", "gsplat"], ["fox"]))
    assert "; means over 1 to 2 seeds each, of 42, 43 and 44." in said
    said = foot(asked("7", of_rows), choose(asked("7", of_rows[1:]), ["pop", "gsplat"], ["fox"]))
    assert "; one seed each, of 43 and 44." in said
    ours = [result("pop", "bicycle", scale="paper", schedule=STEPS)]
    said = foot(asked("7", ours, scale="paper"), choose(asked("7", ours, scale="paper"), ["pop"], ["bicycle", "room"]))
    assert said.endswith("Scale paper: the published protocol. Not every row was run on room.")


def test_a_figure_of_times_is_of_one_machine_and_says_what_was_timed_elsewhere():
    runs = [result("pop"), result("gsplat", machine="another"), result("3dgs"), result("taming", cpu="another kind")]
    made = drawn("1", runs)
    assert {line["row"] for line in lines(made)} == {"pop", "3dgs"}
    said = texts(made)
    assert "Time on a machine (a kind), native, 1 thread." in said
    assert "Timed on another machine: gsplat, Taming-3DGS." in said
    assert "Not run: PUP-3DGS, PUP-3DGS*, Mini-Splatting, Mini-Splatting* and Speedy-Splat." in said
    # one with POP comes before one with more rows
    made = drawn("1", [replace(runs[0], cpu=None), *runs[2:], result("pup")])
    assert {line["row"] for line in lines(made)} == {"pop"}
    assert "a machine (of an unknown kind)" in texts(made)
    untimed = [result("pop", seconds={"load": 1.0, "train": 9.0, "evaluate": 1.0})]
    assert "1 thread, by the clock though" in texts(drawn("1", untimed))


def test_captures_whose_times_are_by_the_clock_are_left_out_where_another_has_every_row():
    clock = {"seconds": {"load": 1.0, "train": 9.0, "evaluate": 1.0}}
    fox, bear = [result("pop"), result("gsplat", **clock)], [result(row, "bear_512") for row in ("pop", "gsplat")]
    made = drawn("1", [*fox, *bear])
    assert {line["scene"] for line in lines(made)} == {"bear_512", "mean"}
    said = texts(made)
    assert "Without fox: time there is by the clock. Capture bear_512" in said
    assert "by the clock though" not in said
    # not where that would leave a row out
    made = drawn("1", [*fox, bear[0]])
    assert {line["scene"] for line in lines(made)} == {"fox", "mean"}
    assert "by the clock though" in texts(made)


def test_at_the_papers_scale_a_figure_is_of_the_papers_scenes():
    runs = [result(row, scene, scale="paper") for row in ("pop", "gsplat") for scene in ("train", "truck", "bonsai")]
    made = drawn("1", runs, scale="paper")
    assert {line["scene"] for line in lines(made)} == {"train", "truck", "mean"}
    with pytest.raises(NoDataError, match="not run are 3dgs on kitchen"):
        drawn("2", runs, scale="paper")


def test_rows_are_compared_on_the_scenes_that_most_of_them_have():
    def chosen(*runs: tuple[str, str]):
        some = [result(row, scene) for row, scene in runs]
        return choose(asked("7", some), ["pop", "gsplat", "3dgs"], ["fox", "bear_512", "garden_512"])

    common = chosen(
        ("pop", "fox"), ("pop", "bear_512"), ("gsplat", "fox"), ("gsplat", "bear_512"), ("3dgs", "bear_512")
    )
    assert (common.scenes, common.missing, common.left_out) == (("bear_512",), (), ("fox", "garden_512"))
    # none that all have: as many rows as can be, and then as many scenes
    apart = chosen(
        ("pop", "fox"), ("pop", "bear_512"), ("gsplat", "fox"), ("gsplat", "bear_512"), ("3dgs", "garden_512")
    )
    assert (apart.scenes, apart.missing) == (("fox", "bear_512"), ("3dgs",))
    assert list(apart.runs) == ["pop", "gsplat"]


def test_a_mean_curve_is_over_seeds_first_and_only_where_every_run_has_points():
    a = result(seed=1, curve=curve({0: 10, 10: 30}))
    b = result(seed=2, curve=curve({0: 20, 5: 40, 10: 60}))
    c = result(scene="bear_512", curve=curve({2: 100, 8: 400}))
    steps, values = curve_of({"fox": (a, b), "bear_512": (c,)}, ("fox", "bear_512"), "num_gaussians")
    assert steps.tolist() == [2, 5, 8]
    fox = [((10 + 2 * s) + (20 + 4 * s)) / 2 for s in (2, 5, 8)]
    bear = [100 + 50 * (s - 2) for s in (2, 5, 8)]
    assert values.tolist() == pytest.approx([(x + y) / 2 for x, y in zip(fox, bear, strict=True)], rel=1e-12)


def test_every_method_has_a_name_and_a_colour_of_its_own():
    shown = {line.row: line.name for table in paper().tables[:2] for line in table.rows}
    for row, printed in shown.items():
        assert style.name_of(row).lower() == printed.replace("Ours", "POP").lower()
    plain = [row for row in shown if not row.endswith("_star")]
    assert len({style.color_of(row) for row in plain}) == len(plain)
    assert {style.name_of("pup_star"), style.color_of("pup_star")} == {"PUP-3DGS*", style.color_of("pup")}


def test_names_are_moved_apart_and_no_more_than_that():
    assert style.spread([1.0, 20.0, 40.0], 8.0, 100.0) == [1.0, 20.0, 40.0]
    assert style.spread([10.0, 10.0], 8.0, 100.0) == [6.0, 14.0]
    assert style.spread([0.0, 9.0, 10.0], 8.0, 100.0) == pytest.approx([-5 / 3, 19 / 3, 43 / 3])
    assert style.spread([98.0, 99.0], 8.0, 100.0) == [92.0, 100.0]
    generator = np.random.default_rng(0)
    for _ in range(50):
        wanted = sorted(generator.uniform(0.0, 60.0, 8))
        placed = style.spread(wanted, 7.0, 60.0)
        assert np.diff(placed).min() > 7.0 - 1e-9
        assert max(placed) < 60.0 + 1e-9


@pytest.mark.parametrize(("n", "text"), [(850, "850"), (1500, "1.5k"), (67038, "67k"), (2_500_000, "2.5M"), (0, "0")])
def test_numbers_are_written_short(n, text):
    assert style.count(n) == text


@pytest.mark.parametrize(
    ("low", "high"), [(3.0, 40.0), (190.0, 240.0), (0.05, 1.5), (2e3, 5e6), (1.0, 1.05), (67000.0, 67200.0)]
)
def test_a_logarithmic_axis_has_a_few_marks(low, high):
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    style.log_ticks(axes.xaxis, low, high)
    marks = [x for x in axes.get_xticks() if low <= x <= high]
    assert 2 <= len(marks) <= 6
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert len(set(labels)) == len(labels)


def test_an_unknown_figure_is_refused_before_anything_is_read(tmp_path):
    with pytest.raises(PopError, match="figure is '8'; it must be one of 1, 2, 3, 4a, 4b, 5, 6a, 6b, 7"):
        figures.draw("8", "small", tmp_path, tmp_path)


def test_rows_name_the_figures_that_show_them():
    by_figure = {figure: {row.name for row in load_rows() if figure in row.figures} for figure in FIGURES}
    assert by_figure["1"] == {*METHODS, "pup_star", "mini_splatting_star"}
    assert by_figure["7"] == set(METHODS)
    assert (by_figure["2"], by_figure["4a"]) == ({"3dgs"}, {"pop"})
    assert by_figure["4b"] == by_figure["5"] == {"3dgs", "pop"}
    assert by_figure["6a"] == {"l1_div_1", "l2_without_ssim", "l2"}
    assert by_figure["6b"] == {"l2", *(f"l1_div_{n}" for n in (1, 2, 5, 10, 20, 50, 100))}


def test_the_list_of_figures_is_read_without_drawing():
    code = "import sys, paper_repro.figures; assert not {'matplotlib', 'numpy', 'torch'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


# Names next to markers: each at its own, none over another, inside the frame where that is possible.

FRAME = (30.0, 70.0, 230.0, 210.0)
# three that stand close together, two that nearly coincide, two that overlap, and two alone
CLUSTERS = [
    Marker(119.4, 187.4, 9.2, 18.0, 14.7),
    Marker(117.8, 192.8, 10.2, 19.7, 14.7),
    Marker(140.6, 89.7, 3.2, 32.6, 14.7),
    Marker(191.6, 118.4, 3.9, 35.8, 14.7),
    Marker(148.0, 139.2, 3.9, 44.2, 14.7),
    Marker(147.7, 136.0, 3.5, 47.4, 14.7),
    Marker(88.4, 150.1, 3.5, 43.2, 14.7),
    Marker(70.5, 153.6, 2.8, 42.4, 14.7),
    Marker(85.0, 158.8, 4.1, 18.0, 14.7),
]


def overlap(a, b):
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)


def distance(box, marker):
    dx = max(box[0] - marker.x, marker.x - box[2], 0.0)
    dy = max(box[1] - marker.y, marker.y - box[3], 0.0)
    return max((dx * dx + dy * dy) ** 0.5 - marker.radius, 0.0)


def test_a_name_alone_stands_to_the_right_or_where_there_is_room():
    [place] = places([Marker(100.0, 100.0, 4.0, 20.0, 10.0)], FRAME)
    assert place.box == (106.0, 95.0, 126.0, 105.0)
    assert not place.is_joined
    [place] = places([Marker(225.0, 100.0, 4.0, 20.0, 10.0)], FRAME)
    assert place.box[2] == 219.0
    # a line that leads to the right
    [place] = places([Marker(100.0, 100.0, 4.0, 20.0, 10.0)], FRAME, along([(100.0, 100.0), (150.0, 100.0)]))
    assert place.box[2] == 94.0


def test_names_of_close_markers_cover_nothing_and_are_nearest_to_their_own_or_joined_to_it():
    found = places(CLUSTERS, FRAME)
    assert [overlap(a.box, b.box) for a, b in itertools.combinations(found, 2)] == [0.0] * 36
    for marker, place in zip(CLUSTERS, found, strict=True):
        assert overlap(place.box, FRAME) > 0.999 * marker.width * marker.height
        others = [other for other in CLUSTERS if other is not marker]
        assert min(distance(place.box, other) for other in others) > 0.0
        if not place.is_joined:
            assert distance(place.box, marker) <= min(distance(place.box, other) for other in others)
    assert sum(place.is_joined for place in found) <= 2
    # their order changes no place of markers far apart
    apart = [CLUSTERS[2], CLUSTERS[3], CLUSTERS[1]]
    assert places(apart, FRAME) == places(apart[::-1], FRAME)[::-1]


def keep(folder: Path, row: str, scene: str, render: np.ndarray, photo: np.ndarray, psnr: float) -> None:
    """Leave what a run keeps of its first held-out view."""
    kept = folder / "small" / row / f"{scene}_42" / "report_data"
    kept.mkdir(parents=True)
    np.savez(kept / "val_step9999_0000.npz", name="a.png", render=render, photo=photo, psnr=psnr, ssim=0.9)


@pytest.fixture
def renders(tmp_path):
    """Two scenes with the renders of both rows, which differ in one place each."""
    generator, places = np.random.default_rng(1), {"fox": (30, 50), "bear_512": (5, 2)}
    for scene, (x, y) in places.items():
        height, width = (80, 45) if scene == "fox" else (40, 60)
        photo = generator.integers(0, 200, (height, width, 3), dtype=np.uint8)
        other = photo.copy()
        other[y : y + 10, x : x + 10] += 40
        keep(tmp_path, "pop", scene, photo, photo, 30.0)
        keep(tmp_path, "3dgs", scene, other, photo, 20.5)
    return tmp_path, places


def test_the_grid_of_renders_boxes_the_place_where_they_differ(renders):
    folder, places = renders
    runs = [result(row, scene, psnr=psnr) for row, psnr in (("pop", 30.0), ("3dgs", 20.5)) for scene in places]
    with style.look():
        made = qualitative.renders_and_photographs(asked("5", runs, folder))
        paths = save(made, folder / "figure_5")
    ET.parse(paths[0])
    for line in lines(made):
        # the whole of the place is in the box
        for inside, corner in zip(places[line["scene"]], (line["box_x"], line["box_y"]), strict=True):
            assert 0 <= inside - corner <= line["box_side"] - 10
        assert line["psnr"] == (30.0 if line["row"] == "pop" else 20.5)
    assert "30.00 dB" in texts(made)
    # a scene that was trained elsewhere is not said not to be run; the folder's renders are of another training of it
    with style.look():
        runs[1] = result("pop", "bear_512", psnr=30.1)
        without = texts(qualitative.renders_and_photographs(asked("5", runs, folder)))
    assert "The work folder has no renders of bear_512." in without
    assert all("Not every row was run on garden_512 and bonsai_800." in said for said in (texts(made), without))


def test_the_grid_in_the_repository_is_of_the_still_life_and_worth_showing():
    with (RESULTS / "shown" / "figures" / "figure_5.csv").open(encoding="utf-8", newline="") as file:
        found = list(csv.DictReader(file))
    assert [(line["scene"], line["row"]) for line in found] == [("still_life", "pop"), ("still_life", "3dgs")]
    assert all(float(line["psnr"]) > 25.0 for line in found)


def test_the_figure_of_the_readme_is_of_the_results_that_are_kept(tmp_path):
    assert main(["figure", "1", "--scale", "small", "--out", str(tmp_path)]) == 0
    (kept,) = re.findall(rb"Source\0sha256:([0-9a-f]{64})", (ROOT / "docs" / "figure_1.png").read_bytes())
    now = hashlib.sha256((tmp_path / "figure_1.csv").read_bytes()).hexdigest()
    assert kept.decode() == now, "run 'pop-repro figure 1 --scale small --out out' and copy figure_1.png to docs/"
    assert "](docs/figure_1.png)" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_without_renders_or_a_scene_figures_say_where_they_looked(tmp_path):
    runs = [result("pop"), result("3dgs")]
    with pytest.raises(NoDataError, match=rf"whose renders are in {tmp_path}; give the folder .* --results NEW, and"):
        qualitative.renders_and_photographs(asked("5", runs, tmp_path))
    with pytest.raises(PopError, match=f"{tmp_path} has none of kitchen; name another --data"):
        artifact.pushed(asked("3", [], tmp_path, scale="paper"))


def test_the_most_different_square_is_that_of_a_search_over_all():
    generator = np.random.default_rng(2)
    for _ in range(10):
        one, other = generator.integers(0, 256, (2, 9, 13, 3), dtype=np.uint8)
        squares = ((one.astype(int) - other.astype(int)) ** 2).sum(axis=2)
        places = [(y, x) for y in range(9 - 4 + 1) for x in range(13 - 4 + 1)]
        y, x = max(places, key=lambda p: squares[p[0] : p[0] + 4, p[1] : p[1] + 4].sum())
        assert qualitative.most_different(one, other, 4) == (x, y)


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory):
    """Figure 3 of a few steps from the demo capture's first Gaussians instead of a finished run's."""
    from pop_fast.data import initialize_params
    from pop_fast.io.ply import save_ply

    folder = tmp_path_factory.mktemp("artifact")
    how = Options(data=folder, work=folder)
    job = job_named("3dgs", "demo", "toy")
    config = job.config(data=str(capture_folder(job.scene, how)), result_dir=str(folder / "none"))
    params = initialize_params(load_capture_of(job, config)[0], 0)
    ply = job.work(folder) / "ply" / "point_cloud_299.ply"
    save_ply(ply, params)
    base = result("3dgs", "demo", scale="toy", schedule={"max_steps": 300}, ply_hash=file_hash(ply))
    with pytest.MonkeyPatch.context() as patch, style.look():
        patch.setattr(artifact, "STEPS", 12)
        toy = asked("3", [base], folder, scale="toy")
        first = artifact.pushed(toy)
        # those of another training of the row are not taken for the result's
        patch.setattr(artifact, "train_row", Mock(side_effect=PopError("trained for it")))
        with pytest.raises(PopError, match="trained for it"):
            artifact._base(asked("3", [replace(base, ply_hash="0" * 64)], folder, scale="toy"), job)
        patch.setattr(artifact, "_train", lambda *_: pytest.fail("trained again"))
        made = artifact.six_panels(toy)
        return params, first, made, save(made, folder / "figure_3")


@pytest.mark.slow  # it trains
def test_the_run_behind_the_artifacts_raises_every_opacity(artifacts):
    params, found, *_ = artifacts
    before = 1.0 / (1.0 + np.exp(-params["opacities"].numpy()))
    assert len(before) == len(found.opacities)
    assert float((found.opacities.numpy() > before).mean()) > 0.99


def test_the_six_panels_have_the_gradients_of_their_losses(artifacts):
    _, found, made, paths = artifacts
    ET.parse(paths[0])
    panels = {panel.key: panel for panel in artifact.panels_of(found)}
    error = np.abs(found.image.numpy().astype(float) - found.photo.numpy()).mean(axis=2)
    np.testing.assert_allclose(panels["error"].values, error, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(panels["grad_l2"].values, 2.0 * error, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(panels["grad_l1"].values[error > 1e-3].max(), 1.0, rtol=1e-5)
    assert panels["grad_l2"].correlation == pytest.approx(1.0, abs=1e-6)
    assert panels["grad_l1"].correlation is None or abs(panels["grad_l1"].correlation) < 0.2
    r = np.corrcoef(panels["grad_ssim"].values.ravel().astype(float), error.ravel())[0, 1]
    assert panels["grad_ssim"].correlation == pytest.approx(r, rel=1e-4)
    told = {line["quantity"]: line for line in lines(made)}
    assert told["grad_ssim"]["mean"] == pytest.approx(float(panels["grad_ssim"].values.mean()), rel=1e-6)
    assert "not the paper's protocol" in texts(made)


def test_a_constant_map_has_no_correlation():
    ramp = np.arange(12.0).reshape(3, 4)
    assert artifact.correlation(np.full((3, 4), 0.3), ramp) is None
    assert artifact.correlation(ramp, -2.0 * ramp + 1.0) == pytest.approx(-1.0, rel=1e-12)
