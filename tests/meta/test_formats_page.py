"""docs/FORMATS.md says what the program's table of formats says."""

from __future__ import annotations

import runpy
from pathlib import Path

from pop_fast.io.formats import FORMATS

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_page_is_the_one_that_is_made() -> None:
    made = runpy.run_path(str(DOCS / "formats.py"))["page"]()
    assert (DOCS / "FORMATS.md").read_text(encoding="utf-8") == made, "run 'python docs/formats.py --write'"


def test_every_format_says_what_it_loses_of_every_field() -> None:
    fields = ["centre", "scale", "rotation", "opacity", "colour", "view dependence"]
    assert all(list(format.losses) == fields for format in FORMATS.values())
