"""The hook of `make site`: links of the repository lead to the same files on the site."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
spec = importlib.util.spec_from_file_location("site_hook", ROOT / "docs" / "site.py")
assert spec is not None
assert spec.loader is not None
site = importlib.util.module_from_spec(spec)
spec.loader.exec_module(site)


@pytest.mark.parametrize(
    ("path", "where"),
    [
        ("README.md", "index.md"),
        ("docs/kit.md", "kit.md"),
        ("docs/demo.png", "demo.png"),
        ("pop_ref/alpha.py", "source/pop_ref/alpha.py.md"),
        ("pop_ref/conformance/LAWS.md", "source/pop_ref/conformance/LAWS.md"),
        ("benchmarks/results/scorecards", "source/benchmarks/results/scorecards.md"),
        ("pop_ref/walkthrough/chapter_04b_tiles.py", "learn/chapter_04b_tiles.html"),
    ],
)
def test_every_file_has_its_place(path: str, where: str) -> None:
    assert site.place(path) == where


@pytest.mark.parametrize(
    ("page", "link", "turned"),
    [
        ("README.md", "docs/kit.md", "kit.md"),
        ("README.md", "pop_ref/learn/splat.py", "source/pop_ref/learn/splat.py.md"),
        ("docs/kit.md", "MUTANTS.md", "MUTANTS.md"),
        ("docs/learn.md", "../README.md", "index.md"),
        ("docs/speed.md", "../benchmarks/NOTES.md#where", "source/benchmarks/NOTES.md#where"),
        ("paper_repro/README.md", "claims.py", "claims.py.md"),
        ("docs/learn.md", "../pop_ref/walkthrough/chapter_01b_learning.py", "learn/chapter_01b_learning.html"),
        ("paper_repro/README.md", "../docs/paper.md", "../../paper.md"),
        ("docs/kit.md", "https://example.org/a.py", "https://example.org/a.py"),
    ],
)
def test_links_are_turned(page: str, link: str, turned: str) -> None:
    assert site.with_links_of_the_site(f"see [it]({link}).", page) == f"see [it]({turned})."


def test_all_that_pages_lead_to_is_there_and_pages_in_markdown_are_followed() -> None:
    made = site.linked(["README.md", "docs/paper.md"])
    assert "paper_repro/protocol.md" in made
    assert "pop_ref/settings.py" in made  # protocol.md leads there, not docs/paper.md
    assert all((ROOT / path).exists() for path in made)


def test_a_fence_is_longer_than_any_within() -> None:
    made = site.content("docs/site.py")
    inside = max(len(run) for run in re.findall(r"`+", (ROOT / "docs" / "site.py").read_text(encoding="utf-8")))
    fence = re.findall(r"^(`+)\{\.python", made, re.MULTILINE)[0]
    assert len(fence) > inside


def test_formulas_need_no_script() -> None:
    made = site.with_formulas("the mean $\\mu_i$, and `$HOME` stays")
    assert "<math" in made
    assert "\\mu" not in made
    assert "`$HOME` stays" in made


def test_no_page_on_learning_leads_to_the_source_of_a_chapter() -> None:
    text = (ROOT / "docs" / "learn.md").read_text(encoding="utf-8")
    assert text.count("](../pop_ref/walkthrough/chapter_") == 17
    links = site.LINK.findall(site.with_links_of_the_site(text, "docs/learn.md"))
    assert not [target for _, target, _ in links if target.startswith("source/pop_ref/walkthrough")]
    assert not [path for path in site.linked(["docs/learn.md"]) if path.startswith("pop_ref/walkthrough")]


def test_chapters_lead_back_to_the_site_and_have_been_built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(site, "WALKTHROUGH", tmp_path)
    with pytest.raises(FileNotFoundError, match="run 'make walkthrough' first"):
        site.walkthrough()
    (tmp_path / "notebooks").mkdir()
    for name in ("index.html", "notebooks/index.html"):
        (tmp_path / name).write_text("<body><main><h1>It</h1></main></body>", encoding="utf-8")
    (tmp_path / "book.pdf").write_bytes(b"%PDF-\xff")
    made = site.walkthrough()
    assert b'<main><nav><a href="../index.html">' in made["learn/index.html"]
    assert b'<a href="../../learn.html">Learn</a></nav><h1>It' in made["learn/notebooks/index.html"]
    assert made["learn/book.pdf"] == b"%PDF-\xff"
