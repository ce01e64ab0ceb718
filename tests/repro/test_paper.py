"""The reproduction's words: paper.toml is what the paper prints; protocol.md, README.md and claims.md are whole."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro import status
from paper_repro.paper import PAPER, Statement, checks, load, paper, places
from paper_repro.results import RESULTS, SCALES, Result, read_all
from paper_repro.status import HERE, files, status_table, with_part
from pop_fast.errors import PopError
from pop_ref.ambiguities import AMBIGUITIES
from pop_ref.settings import POP, Recipe
from tests.repro.made import whole as result

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
FILES = {
    "main_eval_360_and_deep.csv": {1},
    "main_eval_tank.csv": {2},
    "ablation_module.csv": {3},
    "ablation_blur_dense_iter.csv": {4},
    "ablation_opacity.csv": {5},
    "all_tables.csv": {1, 2, 3, 4, 5},
}
CELLS = {
    (table.label, dataset, TRANSCRIBED.get(line.name, line.name.replace(" + ", "+")), metric): value
    for table in paper().tables
    for line in table.rows
    for dataset in table.datasets
    for metric, value in line.values[dataset].items()
}


@needs_the_source
@pytest.mark.parametrize("name", FILES)
def test_every_cell_is_as_transcribed_and_none_is_missing(name: str) -> None:
    with open(SHARED / name, encoding="utf-8", newline="") as file:
        rows = [(r["table"], r["dataset"], r["method"], r["metric"], float(r["value"])) for r in csv.DictReader(file)]
    labels = {paper().table(number).label for number in FILES[name]}
    assert {row[:4]: row[4] for row in rows} == {cell: value for cell, value in CELLS.items() if cell[0] in labels}
    assert len(rows) == len({row[:4] for row in rows})


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
    for table in paper().tables:
        told = [
            [(line.values[d][m], line.marks[d][m]) for d in table.datasets for m in table.metrics]
            for line in table.rows
        ]
        assert found[table.label] == told, table.label


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
    for table in told.tables:
        assert set(table.datasets) <= set(told.datasets)
        for line in table.rows:
            assert all((dataset, line.row) in told.lpips for dataset in table.datasets)


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


def test_every_detail_says_what_it_rests_on() -> None:
    details = re.findall(r"^- \*\*P\d+\. .*$", PROTOCOL, flags=re.MULTILINE)
    evidence = re.compile(r"\*(paper|source|derived|here)\*")
    # the last is a rule of this project
    assert [d[:40] for d in details[:-1] if not evidence.search(d)] == []


def test_every_label_that_is_referred_to_is_there() -> None:
    there = set(re.findall(r"^- \*\*([PC]\d+)\. ", PROTOCOL, flags=re.MULTILINE)) | {a.id for a in AMBIGUITIES}
    named = set(re.findall(r"\b([PCA]\d{1,2})\b", PROTOCOL))
    assert named <= there
    assert {n.id for n in paper().not_comparable} <= there


def test_every_open_question_is_listed_with_its_default() -> None:
    part = PROTOCOL.partition("<!-- ambiguities:begin -->")[2].partition("<!-- ambiguities:end -->")[0]
    lines = {line.split(" | ")[0].strip("| "): line for line in part.splitlines() if line.startswith("| A")}
    assert list(lines) == [a.id for a in AMBIGUITIES] == [f"A{n}" for n in range(1, 33)]
    assert all(a.default in lines[a.id] for a in AMBIGUITIES)


@pytest.mark.parametrize("name", ["README.md", "protocol.md", "claims.md"])
def test_every_link_leads_somewhere(name: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", (HERE / name).read_text(encoding="utf-8")):
        assert (HERE / target).exists(), target


@pytest.mark.parametrize(
    ("path", "text"), files(FOUND).items(), ids=lambda value: value.name if isinstance(value, Path) else ""
)
def test_what_is_made_from_the_results_is_current(path: Path, text: str) -> None:
    assert path.read_text(encoding="utf-8") == text, "run 'python -m paper_repro.status --write'"


def seeds(row: str, n: int, **more: Any) -> list[Result]:
    """Make a row on fox with two seeds that differ by a thousandth of their Gaussians."""
    return [result(row, n=round(n * (1.0 + off)), seed=42 + i, **more) for i, off in enumerate((-0.0005, 0.0005))]


def test_a_new_result_changes_what_is_made_from_it() -> None:
    told = [*seeds("pop", 40_000, commit="abcdef1"), *seeds("l2_blur", 100_000, commit="abcdef1")]
    lines = status_table(told).splitlines()
    half = next(line for line in lines if line.startswith("| POP cuts"))
    assert "| holds at scale small: holds on fox |" in half
    assert half.endswith("| abcdef1 |")
    assert any("small: 2 of 16" in line for line in lines if line.startswith("| table 3"))
    assert len(lines) == 2 + 12 + 5 + 1
    # a claim without its runs names the command that trains them
    blur = next(line for line in lines if line.startswith("| the blur rule multiplies"))
    assert "| `pop-repro queue --scale small --data DATA --rows l2 l2_pop --scenes fox` |" in blur
    made = {path.relative_to(HERE.parent).as_posix(): text for path, text in files(told).items()}
    assert "N pop / l2_blur 40.0% (39.9% to 40.1%)" in made["paper_repro/claims.md"]
    assert "holds at scale small" in made["paper_repro/README.md"]
    reset = [*seeds("pop", 40_000, psnr=31.0), *seeds("reset", 40_000)]
    for name in ("README.md", "docs/paper.md"):
        assert "- POP is no worse than opacity reset in PSNR: **not decided**" in made[name]
        text = next(text for path, text in files(reset).items() if path == HERE.parent / name)
        assert "- POP is no worse than opacity reset in PSNR: **holds** at scale small (fox PSNR pop - reset +1" in text


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


def test_the_script_writes_and_checks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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
