"""The reproduction's words and tables: paper.toml is what the paper prints, and the pages are whole.

Tables from results have means and spreads, what is compared with the paper and what must not be, and no blank cell.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro import status
from paper_repro.claims import claims, noise_of
from paper_repro.evidence import PSNR, compare, groups
from paper_repro.paper import PAPER, Statement, checks, load, paper, places
from paper_repro.results import RESULTS, SCALES, Result, read_all, write
from paper_repro.status import HERE, everything, files, status_table, with_part
from paper_repro.table_formats import COLUMNS, PREAMBLE, csv_text, latex, markdown
from paper_repro.tables import BEYOND, REFERENCES, SCENES_OF, Line, Table, beyond, setting, table
from pop_fast.errors import PopError
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.settings import POP, Recipe
from tests.repro.made import result, whole

SHARED = Path(__file__).resolve().parents[3] / "shared" / "paper"
SOURCE = SHARED / "pop_paper.tex"
needs_the_source = pytest.mark.skipif(not SOURCE.is_file(), reason="../shared/paper with the LaTeX source is absent")

# names of the transcription that are not those of the printed tables
TRANSCRIBED = {"Gsplat": "gsplat", "Ours": "POP (Ours)"} | {
    f"3k--{end}k": f"POP blur 3k-{end}k" for end in (4, 7, 11, 15)
}
# stated numbers that the transcription writes as text
AS_TEXT = {
    "l2_over_l1_gradient_range": ("2/255 to 2", (2 / 255, 2.0)),
    "pup_default_schedule": ("100->20%->10%", (1.0, 0.2, 0.1)),
    "pup_star_schedule": ("100->30%->15%", (1.0, 0.3, 0.15)),
    "speedup_vs_taming_TT": (">=30% less time", 0.3),
    "gpu": ("RTX 4090", "RTX 4090"),
    "pup_compression": ("1/10", 0.1),
}
CELLS = {
    (table.label, dataset, TRANSCRIBED.get(line.name, line.name.replace(" + ", "+")), metric): value
    for table in paper().tables
    for line in table.rows
    for dataset in table.datasets
    for metric, value in line.values[dataset].items()
}


@needs_the_source
def test_every_cell_is_as_transcribed_and_none_is_missing() -> None:
    with open(SHARED / "all_tables.csv", encoding="utf-8", newline="") as file:
        rows = [(r["table"], r["dataset"], r["method"], r["metric"], float(r["value"])) for r in csv.DictReader(file)]
    assert {row[:4]: row[4] for row in rows} == CELLS
    assert len(rows) == len(CELLS)


@needs_the_source
def test_the_stated_numbers_are_as_transcribed() -> None:
    with open(SHARED / "stated_numbers.csv", encoding="utf-8", newline="") as file:
        rows = {row["item"]: row["value"] for row in csv.DictReader(file)}
    assert set(rows) <= set(paper().stated)
    for item, told in rows.items():
        if item in AS_TEXT:
            assert AS_TEXT[item][0] == told
            assert paper().stated[item].value == AS_TEXT[item][1]
        else:
            assert paper().stated[item].value == float(told), item


@needs_the_source
@pytest.mark.parametrize("stated", paper().stated.values(), ids=lambda s: s.id)
def test_every_stated_number_stands_in_the_source(stated) -> None:
    assert SOURCE.read_text(encoding="utf-8").count(stated.quote) >= 1


def printed_tables() -> Iterator[tuple[str, list[list[tuple[float, int]]]]]:
    """Read label, and value and mark of every numeric cell line by line, of the five tables of the LaTeX source."""
    source = SOURCE.read_text(encoding="utf-8")
    for body in re.findall(r"\\begin\{table\*\}.*?\\end\{table\*\}|\\begin\{table\*\}.*\Z", source, re.DOTALL):
        label = re.search(r"\\label\{(tab:[^}]*)\}", body)
        lines = body.partition(r"\midrule")[2].partition(r"\bottomrule")[0].split(r"\\")
        assert label
        yield label[1], [[*map(printed, cells)] for line in lines if len(cells := numeric(line)) > 1]


def numeric(line: str) -> list[str]:
    """Give the cells of a line that hold a number."""
    return [cell.strip() for cell in line.split("&") if re.fullmatch(r"[\d.,]+k?", bare(cell))]


def bare(cell: str) -> str:
    """Take colours and bold face off a cell."""
    return re.sub(r"\\textbf\{([^}]*)\}", r"\1", re.sub(r"\\cellcolor\{\w+\}", "", cell)).strip()


def printed(cell: str) -> tuple[float, int]:
    """Read a cell's value, and its place among the best: by colour, or 1 for bold face."""
    colours = {"bestred": 1, "secondorange": 2, "thirdyellow": 3}
    colour = re.search(r"\\cellcolor\{(\w+)\}", cell)
    mark = colours[colour[1]] if colour else int(r"\textbf" in cell)
    return float(bare(cell).replace(",", "").removesuffix("k")), mark


@needs_the_source
def test_every_value_and_every_colour_is_that_of_the_source() -> None:
    found = dict(printed_tables())
    assert set(found) == {table.label for table in paper().tables}
    for each in paper().tables:
        told = [
            [(line.values[d][m], line.marks[d][m]) for d in each.datasets for m in each.metrics] for line in each.rows
        ]
        assert found[each.label] == told, each.label


def test_there_are_five_tables_of_288_cells() -> None:
    # 84 and 54 cells of the main tables, 60, 60 and 30 of the ablations
    sizes = {t.number: sum(len(line.values[d]) for line in t.rows for d in t.datasets) for t in paper().tables}
    assert sizes == {1: 84, 2: 54, 3: 60, 4: 60, 5: 30}
    assert len(CELLS) == 288


def test_scenes_rows_and_encodings_are_known_to_each_other() -> None:
    told = paper()
    assert [len(told.datasets[d]) for d in ("Mip-NeRF 360", "Tanks & Temples", "Deep Blending")] == [9, 2, 2]
    assert len({scene for scenes in told.datasets.values() for scene in scenes}) == 13
    sized = {line.row for number in (1, 2) for line in told.table(number).rows}
    assert set(told.bytes_per_gaussian) == sized
    assert set(told.bytes_per_gaussian.values()) == {236, 248}
    for each in told.tables:
        assert set(each.datasets) <= set(told.datasets)
        assert all((dataset, line.row) in told.lpips for line in each.rows for dataset in each.datasets)


def test_the_defaults_of_the_method_are_the_stated_numbers() -> None:
    told = paper()
    recipe = Recipe()
    pairs = {
        "lambda_ssim": recipe.lambda_ssim,
        "lambda_pop": recipe.lambda_pop,
        "theta_blur": POP.theta_blur,
        "densify_interval": POP.refine_every,
        "densify_start": POP.refine_start_iter,
        "densify_stop": POP.refine_stop_iter,
        "blur_start": POP.blur_start_iter,
        "blur_stop": POP.blur_stop_iter,
    }
    assert {id: told.number(id) for id in pairs} == pairs


def test_a_damaged_file_is_told_by_its_table_and_row(tmp_path: Path) -> None:
    text = PAPER.read_text(encoding="utf-8")
    path = tmp_path / "paper.toml"
    path.write_text(text.replace("[2509, 1304, 595,", "[2509, 1304,"), encoding="utf-8")
    with pytest.raises(PopError, match="table 1: row 3dgs, Mip-NeRF 360: there must be 6 values"):
        load(path)
    path.write_text(text.replace('id = "lambda_pop"', 'id = "lambda_ssim"'), encoding="utf-8")
    with pytest.raises(PopError, match="stated has an id twice"):
        load(path)
    path.write_text("[", encoding="utf-8")
    with pytest.raises(PopError, match=r"paper\.toml: is not TOML"):
        load(path)
    with pytest.raises(PopError, match="table is 6; it must be one of 1, 2, 3, 4, 5"):
        paper().table(6)


# The tables against each other and its text: every check is as it is said to be, and a wrong one fails.

CHECKS = checks(paper())


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.says)
def test_it_holds_or_fails_for_a_known_reason(check: Statement) -> None:
    assert check.holds == (check.known == ""), check.found


def test_what_is_known_not_to_hold_is_little_and_named() -> None:
    assert len([check for check in CHECKS if check.known]) == 7
    assert len(CHECKS) == len({check.says for check in CHECKS}) == 129


CHANGES = [
    ("[3168, 886, 713,", "[3168, 886, 750,", "table 1, Mip-NeRF 360, gsplat: Ckpt is Num x 236 bytes"),
    ('236 = ["gsplat", "pop"]', '236 = ["pop"]\n252 = ["gsplat"]', "table 1, Mip-NeRF 360, gsplat: Ckpt"),
    ("[268, 279, 27.01, 0.760, 0.277]", "[268, 279, 27.02, 0.760, 0.277]", "pop, Mip-NeRF 360: psnr is the same"),
    ("marks = [0, 0, 0, 2, 1, 2]", "marks = [0, 0, 0, 2, 1, 0]", "table 1, Mip-NeRF 360, lpips: the best 3 are marked"),
    ("[318, 305, 75,", "[318, 290, 75,", "POP saves at least 30%"),
    ("[562, 358, 27.17,", "[562, 358, 27.18,", "the window 3k-15k changes PSNR by +0.16 dB"),
    ("[562, 358,", "[962, 358,", "the window 3k-15k takes 2 to 3 times the Gaussians of 3k-7k on Mip-NeRF 360"),
    ("[279, 728, 66, 26.926,", "[279, 728, 66, 27.926,", "POP surpasses speedy_splat in PSNR"),
    ("[548, 328, 26.82,", "[548, 328, 27.82,", "POP is no worse than opacity reset in PSNR on Mip-NeRF 360"),
    ("[346, 329, 82,", "[246, 329, 82,", "POP has the least num_gaussians_k on Mip-NeRF 360"),
]


@pytest.mark.parametrize(("old", "new", "says"), CHANGES, ids=[says for _, _, says in CHANGES])
def test_a_changed_number_is_noticed(old: str, new: str, says: str, tmp_path: Path) -> None:
    text = PAPER.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "paper.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    broken = [check.says for check in checks(load(path)) if not check.holds and not check.known]
    assert any(told.startswith(says) for told in broken), broken


def test_equal_values_share_a_place_and_use_up_the_next() -> None:
    least, most = paper().metrics["ckpt_mb"], paper().metrics["psnr"]
    assert places({"a": 43.0, "b": 43.0, "c": 48.0, "d": 60.0}, least, 3) == {"a": 1, "b": 1, "c": 3, "d": 0}
    assert places({"a": 1.0, "b": 3.0, "c": 2.0}, most, 1) == {"a": 0, "b": 1, "c": 0}
    assert places({}, most, 3) == {}


PROTOCOL = (HERE / "protocol.md").read_text(encoding="utf-8")
FOUND = [r for scale in SCALES for r in read_all(scale, RESULTS)]


@pytest.mark.parametrize("letter", ["P", "C"])
def test_details_are_numbered_without_gaps(letter: str) -> None:
    numbers = [int(n) for n in re.findall(rf"^- \*\*{letter}(\d+)\. ", PROTOCOL, flags=re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) == {"P": 26, "C": 9}[letter]


def test_every_detail_says_what_it_rests_on_and_refers_to_what_is_there() -> None:
    details = re.findall(r"^- \*\*P\d+\. .*$", PROTOCOL, flags=re.MULTILINE)
    evidence = re.compile(r"\*(paper|source|derived|here)\*")
    # the last is a rule of this project
    assert [d[:40] for d in details[:-1] if not evidence.search(d)] == []
    # every label that is referred to is there
    there = set(re.findall(r"^- \*\*([PC]\d+)\. ", PROTOCOL, flags=re.MULTILINE)) | {a.id for a in AMBIGUITIES}
    named = set(re.findall(r"\b([PCA]\d{1,2})\b", PROTOCOL))
    assert named <= there
    assert {n.id for n in paper().not_comparable} <= there


def test_every_open_question_is_listed_with_its_default() -> None:
    part = PROTOCOL.partition("<!-- ambiguities:begin -->")[2].partition("<!-- ambiguities:end -->")[0]
    lines = {line.split(" | ")[0].strip("| "): line for line in part.splitlines() if line.startswith("| A")}
    assert list(lines) == [a.id for a in AMBIGUITIES] == [f"A{n}" for n in range(1, 33)]
    assert all(a.default in lines[a.id] for a in AMBIGUITIES)


@pytest.mark.parametrize(
    ("path", "text"), files(FOUND).items(), ids=lambda value: value.name if isinstance(value, Path) else ""
)
def test_what_is_made_from_the_results_is_current(path: Path, text: str) -> None:
    assert path.read_text(encoding="utf-8") == text, "run 'python -m paper_repro.status --write'"


def test_the_page_of_the_paper_says_what_four_looks_do_to_the_interval_of_garden() -> None:
    small = [r for r in FOUND if r.scale == "small"]
    (reset,) = (c for c in claims("small", small) if c.id == "reset")
    scenes = reset.told.evidence
    on_garden = compare("", groups(small)["garden_512"], noise_of(small), PSNR, {"pop": 1.0, "reset": -1.0})
    half = on_garden.half_width(4 * len(scenes))
    page = (HERE.parent / "docs" / "paper.md").read_text(encoding="utf-8")
    assert f"until five decided it:{on_garden.text(len(scenes))}." in page
    assert f"would be ± {half:.2f} dB, and the claim would still be open there" in page
    assert on_garden.seeds == (5, 5)
    assert on_garden.value < half


def seeds(row: str, n: int, **more: Any) -> list[Result]:
    """Make a row on fox with two seeds that differ by a thousandth of their Gaussians."""
    return [whole(row, n=round(n * (1.0 + off)), seed=42 + i, **more) for i, off in enumerate((-0.0005, 0.0005))]


def test_a_new_result_changes_what_is_made_from_it() -> None:
    told = [*seeds("pop", 40_000, commit="abcdef1"), *seeds("l2_blur", 100_000, commit="abcdef1")]
    lines = status_table(told).splitlines()
    half = next(line for line in lines if line.startswith("| POP cuts"))
    assert "| holds at scale small: holds on fox |" in half
    assert half.endswith("| abcdef1 |")
    assert any("small: 2 of 16" in line for line in lines if line.startswith("| table 3"))
    assert len(lines) == 2 + 12 + 5 + 1
    # the runs of another reading are among those that the line rests on
    other = [*told, *seeds("reset", 50_000, commit="abcdef2"), *seeds("pop_size_prune", 40_000, commit="abcdef3")]
    against_reset = next(line for line in status_table(other).splitlines() if line.startswith("| POP is no worse"))
    assert against_reset.endswith("| abcdef1, abcdef2, abcdef3 |")
    # a claim without its runs names the command that trains them
    blur = next(line for line in lines if line.startswith("| the blur rule multiplies"))
    assert "| `pop-repro queue --scale small --data DATA --rows l2 l2_pop --scenes fox` |" in blur
    made = {path.relative_to(HERE.parent).as_posix(): text for path, text in files(told).items()}
    assert "N pop / l2_blur 40.0% (39.9% to 40.1%)" in made["paper_repro/claims.md"]
    assert "holds at scale small" in made["paper_repro/README.md"]
    reset = [*seeds("pop", 40_000, psnr=31.0), *seeds("reset", 40_000)]
    for name in ("README.md", "docs/paper.md"):
        assert "| POP is no worse than opacity reset in PSNR | small | **not decided**" in made[name]
        text = next(text for path, text in files(reset).items() if path == HERE.parent / name)
        assert "| POP is no worse than opacity reset in PSNR | small | **holds**<br>fox: PSNR pop - reset +1" in text


def test_every_claim_of_the_package_names_a_command() -> None:
    # also one that no number of seeds would decide
    rows = [line.split(" | ") for line in status_table(everything()).splitlines()[2:]]
    assert len(rows) == 12 + 5 + 1
    assert all(row[3].startswith("`pop-repro ") for row in rows)


def test_every_scale_that_decides_a_claim_is_told() -> None:
    told = [*seeds("pop", 80_000), *seeds("l2_blur", 100_000)]
    full = [replace(r, scale="full", scene="bonsai_800") for r in [*seeds("pop", 40_000), *seeds("l2_blur", 100_000)]]
    half = next(line for line in status_table([*told, *full]).splitlines() if line.startswith("| POP cuts"))
    assert "| holds at scale full: holds on bonsai_800; does not hold at scale small: does not hold on fox |" in half


def test_marks_that_are_absent_are_told() -> None:
    assert with_part("a <!-- x:begin -->old<!-- x:end --> b", "x", "new") == (
        "a <!-- x:begin -->\nnew\n<!-- x:end --> b"
    )
    with pytest.raises(PopError, match="no marks <!-- y:begin -->"):
        with_part("a", "y", "new")


def test_the_script_writes_and_checks(tmp_path, monkeypatch, capsys):
    for name in ("README.md", "protocol.md", "claims.md"):
        (tmp_path / name).write_text((HERE / name).read_text(encoding="utf-8"), encoding="utf-8")
    make = status.files
    monkeypatch.setattr(status, "files", lambda found: make(found, tmp_path))
    assert status.main(["--check"]) == 0
    (tmp_path / "claims.md").write_text("old", encoding="utf-8")
    assert status.main(["--check"]) == 1
    assert "claims.md: is not what the results say" in capsys.readouterr().out
    assert status.main(["--write"]) == 0
    assert status.main(["--check"]) == 0
    assert status.main([]) == 0
    assert "| claim or table |" in capsys.readouterr().out


GPU = "an EPYC, NVIDIA GeForce RTX 4090"
FULL = {"vgg_01": 0.2, "alex_norm": 0.1, "alex_01": 0.15}


def on_paper(row: str, scene: str, seed: int = 42, n: int = 268_000, **changes: Any) -> Result:
    """Make a result of the published protocol."""
    return replace(
        result(row, scene, seed, n, **{"machine": GPU, "lpips": FULL, "lpips_reason": None, **changes}), scale="paper"
    )


def line_of(made: Table, block: int, row: str) -> Line:
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
    assert ratios.columns == (
        "fox",
        "bear_512",
        "garden_512",
        "bonsai_800",
        "paper, Mip-NeRF 360",
        "paper, Deep Blending",
    )
    assert ratios.relative["pop"] == ["51.0%, -0.30 dB", *["not run"] * 3, "8.5%, -0.65 dB", "3.9%, -0.95 dB"]
    assert ratios.relative["taming"][:2] == ["not run", "not run"]
    blur = table(3, "small", DEV).ratios
    assert blur.relative["pop"] == [
        "46.4%, -0.20 dB",
        *["not run"] * 3,
        "46.0%, -0.21 dB",
        "48.3%, -0.09 dB",
        "39.7%, +0.07 dB",
    ]
    assert table(1, "paper", []).ratios is None


def test_a_ratio_without_its_base_says_so_and_every_base_is_in_its_table() -> None:
    ratios = table(1, "small", DEV[:1]).ratios
    assert ratios.relative["pop"][0] == "gsplat not run"
    assert {number: base for number, base in REFERENCES.items() if paper().table(number).row(base)} == REFERENCES
    assert set(REFERENCES) == {1, 2, 3, 4, 5}


def test_seconds_are_of_the_processor_on_one_machine_and_others_have_no_place() -> None:
    clock = {"load": 1.0, "train": 50.0, "evaluate": 2.0}
    found = [
        result("gsplat", seconds={**clock, "cpu": 240.0}, threads=2),
        result("pop", seconds={**clock, "cpu": 200.0}, threads=2),
        result("pop", seed=43, seconds={**clock, "cpu": 220.0}, threads=2),
        # neither the machine of another seed nor a faster one changes what is told of this one
        result("pop", seed=44, seconds={**clock, "cpu": 900.0}, threads=2, cpu="another kind"),
        result("3dgs", seconds=clock),
        result("taming", seconds=clock, machine="a machine, a GPU"),
    ]
    made = table(1, "small", found)
    cells = {row: line_of(made, 0, row).cells["time_s"] for row in ("gsplat", "pop", "3dgs", "taming")}
    assert [cell.ours for cell in cells.values()] == ["120", "105 ± 7", "50 (clock)", "50 (elsewhere)"]
    assert [cell.place for cell in cells.values()] == [2, 1, 0, 0]
    assert "(clock) is by the clock of a processor that may have had other work" in markdown(made)
    assert "(elsewhere) is of others, so that it has no place." in markdown(made)
    # one with POP comes before one with more methods, and the title says which
    told = table(1, "small", [result("pop", cpu="a third kind"), result("3dgs"), result("gsplat")])
    assert told.blocks[0].title.endswith("7 held-out views, times on a machine (a third kind), native, 1 thread)")
    assert line_of(told, 0, "3dgs").cells["time_s"].ours == "100 (elsewhere)"
    assert "(elsewhere) is" not in markdown(table(1, "small", found[:3]))


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


@needs_the_source
def test_the_colours_are_those_of_the_paper() -> None:
    colours = re.findall(r"\\definecolor.*", PREAMBLE)
    assert len(colours) == 3
    assert all(colour in SOURCE.read_text(encoding="utf-8") for colour in colours)


def test_what_goes_beyond_the_paper_has_a_table_of_its_own() -> None:
    made = beyond("small", [*DEV, result("final_prune", n=30_000)])
    assert [line.row for line in made.blocks[0].lines] == list(BEYOND)
    assert line_of(made, 0, "final_prune").cells["psnr"].paper == "not in the paper"
    assert line_of(made, 0, "final_prune").cells["ckpt_mb"].ours == "6.8"
    paper_rows = {line.row for t in paper().tables for line in t.rows}
    assert set(BEYOND) & paper_rows == {"pop"}
    # it has no ratios, and does not say that it has
    assert made.header[0].endswith("compared with a number of the paper.")
    assert table(1, "small", DEV).header[0].endswith("ratios within the table stand beside its own.")


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
