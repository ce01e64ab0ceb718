"""Tables from results: means and spreads, what is compared with the paper and what must not be, and no blank cell."""

from __future__ import annotations

import csv
import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro.paper import paper
from paper_repro.results import SCALES, Result, read_all, write
from paper_repro.table_formats import COLUMNS, PREAMBLE, csv_text, latex, markdown
from paper_repro.tables import BEYOND, REFERENCES, SCENES_OF, Line, Table, beyond, setting, table
from pop_fast.errors import PopError
from tests.repro.made import result

GPU = "an EPYC, NVIDIA GeForce RTX 4090"
FULL = {"vgg_01": 0.2, "alex_norm": 0.1, "alex_01": 0.15}


def on_paper(row: str, scene: str, seed: int = 42, n: int = 268_000, **changes: Any) -> Result:
    """Make a result of the published protocol."""
    return replace(
        result(row, scene, seed, n, **{"machine": GPU, "lpips": FULL, "lpips_reason": None, **changes}), scale="paper"
    )


def line_of(made: Table, block: int, row: str) -> Line:
    """Find a line."""
    return next(line for line in made.blocks[block].lines if line.row == row)


DEV = [
    result("pop", "fox", 42, n=50_000, psnr=31.0),
    result("pop", "fox", 43, n=52_000, psnr=31.2),
    result("gsplat", "fox", 42, n=100_000, psnr=31.4),
    result("3dgs", "fox", 42, n=90_000, psnr=31.5),
    result("mini_splatting", "fox", 42, n=40_000, psnr=29.0),
    result("l2_blur", "fox", 42, n=110_000, psnr=31.3),
]
TANKS = [
    on_paper("pop", s, seed, n, psnr=p)
    for seed, n, p in ((1, 260_000, 23.5), (2, 270_000, 23.7))
    for s in ("train", "truck")
]


def test_a_cell_is_the_mean_over_seeds_with_their_spread() -> None:
    line = line_of(table(1, "small", DEV), 0, "pop")
    assert (line.seeds, len(line.runs), line.missing) == (2, 2, ())
    assert line.cells["num_gaussians_k"].ours == "51.0 ± 1.4"
    assert line.cells["psnr"].ours == "31.10 ± 0.14"
    assert line.cells["psnr"].value == pytest.approx(31.1)
    assert line.cells["psnr"].spread == pytest.approx(0.1 * 2**0.5)


def test_one_seed_has_no_spread_and_says_how_many_it_is() -> None:
    made = table(1, "small", DEV)
    assert line_of(made, 0, "gsplat").cells["psnr"].ours == "31.40"
    assert line_of(made, 0, "gsplat").cells["psnr"].spread is None
    assert f"n = 1: {DEV[2].run}" in markdown(made)


def test_a_data_set_is_the_mean_over_its_scenes_of_the_means_over_seeds() -> None:
    # the second scene has one seed more, which must not weigh it more
    extra = on_paper("pop", "truck", 3, n=500_000, psnr=30.0)
    plain, more = (line_of(table(2, "paper", rs), 0, "pop") for rs in (TANKS, [*TANKS, extra]))
    assert plain.cells["psnr"].ours == "23.600 ± 0.141"
    train, truck = 23.6, (23.5 + 23.7 + 30.0) / 3
    assert more.cells["psnr"].value == pytest.approx((train + truck) / 2)
    assert more.cells["psnr"].spread == pytest.approx(0.1 * 2**0.5)
    assert (plain.seeds, more.seeds, len(more.runs)) == (2, 2, 5)


def test_the_papers_protocol_stands_beside_the_papers_numbers() -> None:
    cells = line_of(table(2, "paper", TANKS), 0, "pop").cells
    assert (cells["psnr"].paper, cells["psnr"].difference) == ("23.618", "-0.018")
    assert (cells["num_gaussians_k"].paper, cells["num_gaussians_k"].difference) == ("269", "-4")
    assert (cells["time_s"].paper, cells["time_s"].difference) == ("208", "-108")
    assert cells["psnr"].paper_place == 3
    assert cells["lpips"].ours == "0.100 ± 0.000"


def test_the_variant_of_lpips_is_the_one_that_the_papers_cell_seems_to_hold() -> None:
    made = table(
        1,
        "paper",
        [on_paper(row, s) for row in ("3dgs", "pop", "mini_splatting") for s in paper().datasets["Mip-NeRF 360"]],
    )
    assert [line_of(made, 0, row).cells["lpips"].value for row in ("3dgs", "pop", "mini_splatting")] == [0.2, 0.1, 0.2]
    assert {line.cells["lpips"].place for line in made.blocks[0].lines} == {0}
    deep = table(1, "paper", [on_paper("3dgs", s) for s in ("drjohnson", "playroom")])
    cell = line_of(deep, 1, "3dgs").cells["lpips"]
    assert cell.value == 0.1
    assert cell.difference.startswith("not comparable: which LPIPS")


def test_what_cannot_be_compared_gets_no_difference() -> None:
    scenes = paper().datasets["Mip-NeRF 360"]
    made = table(1, "paper", [on_paper(row, s) for row in ("taming", "pup", "pop") for s in scenes])
    assert all("(C4)" in cell.difference for cell in line_of(made, 0, "taming").cells.values())
    pup = line_of(made, 0, "pup").cells
    assert "(C6)" in pup["time_s"].difference
    assert pup["psnr"].difference == "+3.228"
    cpu = table(1, "paper", [on_paper("pop", s, machine="a processor") for s in scenes])
    assert line_of(cpu, 0, "pop").cells["time_s"].difference == (
        "not comparable: trained on a processor, the paper on RTX 4090 (C5)"
    )


def test_a_mean_over_fewer_scenes_is_neither_compared_nor_ranked() -> None:
    made = table(1, "paper", [on_paper("pop", "bicycle"), on_paper("gsplat", "bicycle"), on_paper("pop", "garden")])
    line = line_of(made, 0, "pop")
    assert line.cells["psnr"].ours == "30.000 (2 of 9 scenes)"
    assert line.cells["psnr"].difference.startswith("not comparable: without flowers, stump,")
    assert {cell.place for one in made.blocks[0].lines for cell in one.cells.values()} == {0}
    assert "POP (Ours): no run of flowers" in markdown(made)


@pytest.mark.parametrize("scale", [s for s in SCALES if s != "paper"])
@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
def test_other_data_never_stands_beside_a_number_of_the_paper(number: int, scale: str) -> None:
    scene = SCENES_OF[scale][0]
    rows = [line.row for line in paper().table(number).rows]
    made = table(number, scale, [replace(result(row, scene), scale=scale) for row in rows])
    cells = [cell for block in made.blocks for line in block.lines for cell in line.cells.values()]
    assert {cell.paper for cell in cells} == {"other data"}
    assert {cell.difference for cell in cells} <= {"other data", "not run", "no weights"}
    assert made.header[0].startswith(f"NOT the paper's protocol: scale {scale}")
    for text in (markdown(made), latex(made)):
        assert "NOT the paper's protocol" in text
        printed = {
            f"{line.values[d]['psnr']:.{paper().table(number).decimals['psnr']}f}"
            for line in paper().table(number).rows
            for d in line.values
        }
        assert not [value for value in printed if value in text]


def test_ratios_stand_beside_the_papers_own() -> None:
    ratios = table(1, "small", DEV).ratios
    assert ratios is not None
    assert ratios.columns == (
        "fox",
        "bear_512",
        "garden_512",
        "bonsai_800",
        "paper, Mip-NeRF 360",
        "paper, Deep Blending",
    )
    assert ratios.relative is not None
    assert ratios.relative["pop"] == ["51.0%, -0.30 dB", *["not run"] * 3, "8.5%, -0.65 dB", "3.9%, -0.95 dB"]
    assert ratios.relative["taming"][:2] == ["not run", "not run"]
    blur = table(3, "small", DEV).ratios
    assert blur is not None
    assert blur.relative is not None
    assert blur.relative["pop"] == [
        "46.4%, -0.20 dB",
        *["not run"] * 3,
        "46.0%, -0.21 dB",
        "48.3%, -0.09 dB",
        "39.7%, +0.07 dB",
    ]
    assert table(1, "paper", []).ratios is None


def test_a_ratio_without_its_base_says_so() -> None:
    ratios = table(1, "small", DEV[:1]).ratios
    assert ratios is not None
    assert ratios.relative is not None
    assert ratios.relative["pop"][0] == "gsplat not run"


def test_the_base_of_every_ratio_is_in_its_table() -> None:
    assert {number: base for number, base in REFERENCES.items() if paper().table(number).row(base)} == REFERENCES
    assert set(REFERENCES) == {1, 2, 3, 4, 5}


def test_seconds_are_of_the_processor_and_those_by_the_clock_have_no_place() -> None:
    clock = {"load": 1.0, "train": 50.0, "evaluate": 2.0}
    found = [
        result("gsplat", seconds={**clock, "cpu": 240.0}, threads=2),
        result("pop", seconds={**clock, "cpu": 200.0}, threads=2),
        result("3dgs", seconds=clock),
        result("taming", seconds=clock, machine="a machine, a GPU"),
    ]
    made = table(1, "small", found)
    cells = {row: line_of(made, 0, row).cells["time_s"] for row in ("gsplat", "pop", "3dgs", "taming")}
    assert [cell.ours for cell in cells.values()] == ["120", "100", "50 (clock)", "50"]
    assert [cell.place for cell in cells.values()] == [3, 2, 0, 1]
    assert "(clock) is by the clock of a processor that may have had other work" in markdown(made)


def test_the_best_three_are_marked_and_ties_alike() -> None:
    made = table(1, "small", DEV)
    assert {r: line_of(made, 0, r).cells["psnr"].place for r in ("3dgs", "gsplat", "pop", "mini_splatting")} == {
        "3dgs": 1, "gsplat": 2, "pop": 3, "mini_splatting": 0,
    }  # fmt: skip
    assert line_of(made, 0, "mini_splatting").cells["num_gaussians_k"].place == 1
    # all took equally long
    assert {line_of(made, 0, r).cells["time_s"].place for r in ("3dgs", "gsplat", "pop", "mini_splatting")} == {1}
    assert line_of(made, 0, "taming").cells["psnr"].place == 0
    text = markdown(made)
    assert "**31.50**" in text
    assert "31.40 (2)" in text
    tex = latex(made)
    assert r"\cellcolor{bestred}31.50" in tex
    assert r"\cellcolor{secondorange}31.40" in tex
    assert r"\cellcolor{thirdyellow}31.10 $\pm$ 0.14" in tex


def test_ablations_mark_the_best_alone_as_in_the_paper() -> None:
    made = table(3, "small", [result("l2", n=10), result("l2_blur", n=30), result("l2_pop", n=20)])
    places = {line.row: line.cells["num_gaussians_k"].place for line in made.blocks[0].lines}
    assert places == {"l2": 1, "l2_blur": 0, "l2_pop": 0, "pop": 0}


def test_absent_data_is_told_from_what_was_not_run() -> None:
    made = table(2, "paper", [], absent=("train", "truck"))
    assert {cell.ours for line in made.blocks[0].lines for cell in line.cells.values()} == {"no data"}
    half = table(2, "paper", [], absent=("train",))
    assert {cell.ours for line in half.blocks[0].lines for cell in line.cells.values()} == {"not run"}
    assert made.header[-1] == "No run of this table is finished."


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 0])
@pytest.mark.parametrize("results", [[], DEV, [*TANKS, on_paper("pup", "bicycle")]], ids=["none", "small", "paper"])
def test_no_cell_is_blank_and_every_line_has_all_columns(results: list[Result], number: int, scale: str) -> None:
    made = table(number, scale, results) if number else beyond(scale, results)
    rows = list(csv.DictReader(io.StringIO(csv_text(made))))
    assert len(rows) == sum(len(block.lines) for block in made.blocks) * len(made.metrics)
    assert all(row[name] for row in rows for name in COLUMNS if name not in ("value", "spread"))
    assert all(bool(row["value"]) == bool(re.match(r"[\d.,]+", row["ours"])) for row in rows)
    for grid in re.findall(r"(?:^\|.*\|$\n?)+", markdown(made), flags=re.MULTILINE):
        lines = [line.strip("|").split("|") for line in grid.strip().splitlines()]
        assert len({len(line) for line in lines}) == 1
        assert all(cell.strip() for line in lines for cell in line)
    tex = latex(made)
    for columns, body in re.findall(r"\\begin\{tabular\}\{@\{\}([lr]+)@\{\}\}(.*?)\\end\{tabular\}", tex, re.DOTALL):
        lines = [line for line in body.splitlines() if line.endswith(r"\\") and r"\multicolumn" not in line]
        assert {len(re.findall(r"(?<!\\)&", line)) for line in lines} == {len(columns) - 1}
    assert tex.count("{") == tex.count("}")
    assert tex.count(r"\begin") == tex.count(r"\end")


def test_the_colours_are_those_of_the_paper() -> None:
    source = Path(__file__).resolve().parents[3] / "shared" / "paper" / "pop_paper.tex"
    if not source.is_file():
        pytest.skip("../shared/paper with the LaTeX source is absent")
    colours = re.findall(r"\\definecolor.*", PREAMBLE)
    assert len(colours) == 3
    assert all(colour in source.read_text(encoding="utf-8") for colour in colours)


def test_what_goes_beyond_the_paper_has_a_table_of_its_own() -> None:
    made = beyond("small", [*DEV, result("final_prune", n=30_000)])
    assert [line.row for line in made.blocks[0].lines] == list(BEYOND)
    assert line_of(made, 0, "final_prune").cells["psnr"].paper == "not in the paper"
    assert line_of(made, 0, "final_prune").cells["ckpt_mb"].ours == "6.8"
    paper_rows = {line.row for t in paper().tables for line in t.rows}
    assert set(BEYOND) & paper_rows == {"pop"}


def test_a_setting_is_found_by_the_end_of_its_name() -> None:
    told = replace(
        DEV[0], schedule={"max_steps": 10_000, "strategy.blur_stop_iter": 2333, "a.x": 1, "b.x": 2, "y": "z"}
    )
    assert setting(told, "max_steps") == 10_000
    assert setting(told, "blur_stop_iter") == 2333
    assert setting(told, "x") is None
    assert setting(told, "y") is None
    assert setting(told, "absent") is None


def test_unknown_names_are_refused() -> None:
    with pytest.raises(PopError, match="table is 7"):
        table(7, "small", [])
    with pytest.raises(PopError, match="scale is 'x'"):
        table(1, "x", [])
    with pytest.raises(PopError, match="scale is 'x'"):
        beyond("x", [])


def test_results_that_were_written_make_the_same_table(tmp_path: Path) -> None:
    for one in DEV:
        write(one, tmp_path)
    assert csv_text(table(1, "small", read_all("small", tmp_path))) == csv_text(table(1, "small", DEV))
