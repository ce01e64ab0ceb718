"""The figures of scale dev that are part of the repository: which there are, and of which results."""

from __future__ import annotations

import csv

import pytest

from paper_repro.figures import FIGURES
from paper_repro.results import RESULTS, read_all

DRAWN = RESULTS / "dev" / "figures"
# a picture of somebody else's photograph is not ours to publish
OF_PHOTOGRAPHS = ("3", "5")
# the opacities are counted over all runs of 3DGS
WITHOUT_RUNS = ("2",)
PUBLISHED = [figure for figure in FIGURES if figure not in OF_PHOTOGRAPHS]


def test_they_are_those_that_show_no_photograph() -> None:
    files = {path.name for path in DRAWN.iterdir()}
    assert files == {f"figure_{figure}.{suffix}" for figure in PUBLISHED for suffix in ("svg", "csv")}


@pytest.mark.parametrize("figure", [figure for figure in PUBLISHED if figure not in WITHOUT_RUNS])
def test_each_is_of_results_that_are_there(figure: str) -> None:
    with (DRAWN / f"figure_{figure}.csv").open(encoding="utf-8", newline="") as file:
        named = {run for line in csv.DictReader(file) for run in (line.get("run") or line.get("runs") or "").split()}
    assert named
    kept = {result.run for result in read_all("dev", RESULTS)}
    assert named <= kept, f"draw it again: pop-repro figure {figure} --scale dev --out {DRAWN}"
