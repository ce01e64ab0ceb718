"""protocol.md, README.md and claims.md of the reproduction: complete, consecutive, and what the results say."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from paper_repro import status
from paper_repro.paper import paper
from paper_repro.results import RESULTS, SCALES, Result, read_all
from paper_repro.status import HERE, files, status_table, with_part
from pop_fast.errors import PopError
from pop_ref.ambiguities import AMBIGUITIES
from tests.repro.made import whole as result

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
