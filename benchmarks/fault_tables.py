"""The tables of docs/reliability.md, from what `benchmarks.faults` and `benchmarks.load` have written."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parent / "results"
_KINDS = ("read", "refused", "told", "escaped", "crashed", "hung")


def fuzzed() -> str:
    """Make the table of damaged files: what came of them, by reader."""
    found = _read("faults.json")["fuzz"]["readers"]
    total = {kind: sum(row[kind] for row in found.values()) for kind in _KINDS}
    rows = [[name, *_outcomes(row)] for name, row in found.items()] + [["**all**", *_outcomes(total)]]
    head = ["reader", "inputs", "read", "refused in a line", "system", "failures", "crash", "hang"]
    return _table(head, ["---", *["---:"] * 7], rows)


def _outcomes(row: dict[str, int]) -> list[str]:
    # a reader that was tried again alone has its seed there too
    counts = [row[kind] for kind in _KINDS]
    return [f"{count:,}" for count in (sum(counts), *counts)]


def disturbed() -> str:
    """Make the table of runs that were killed or refused their writes, of flipped bits and of sanitizers."""
    found = _read("faults.json")
    rows = []
    for kind, kills in found["kills"].items():
        what = f"SIGKILL at random moments of `pop train`, then `--resume`: {kind}"
        tried = f"{kills['kills']:,} kills in {kills['runs']:,} runs"
        rows.append([what, tried, "another ending" if kills["failures"] else "the same bits", _failed(kills)])
    for part, what in (("crashes", "the process ends before"), ("writes", "the system refuses")):
        for job, of in found[part].items():
            came = ", ".join(f"{of[key]} {key}" for key in ("ended", "told", "continued") if of.get(key))
            place = f"{what} a change of the disk: {job}"
            rows.append([place, f"{of['tried']} of {of['points']} places", came, _failed(of)])
    for flips in found["flips"].values():
        came = f"{flips['refused']:,} refused, {flips['the same']:,} read as before"
        rows.append(["a flipped bit of a checkpoint", f"{flips['flips']:,}", came, _failed(flips)])
    return _table(["what happens", "tried", "what came", "failures"], ["---", "---", "---", "---:"], rows)


def sanitized() -> str:
    """Make the table of sanitizers: what was run under which, and of every unit how many of its lines ran."""
    found = _read("faults.json")["sanitizers"]
    rows = [
        [name, of["about"], ", ".join(of.get("told", [])) or f"not tried: {of['skipped']}", _failed(of)]
        for name, of in found["checks"].items()
    ]
    rows += [[f"`{unit}`", "", f"{run} of {of} lines ran", ""] for unit, (run, of) in found["lines"].items()]
    return _table(["what", "under", "tried", "failures"], ["---", "---", "---", "---:"], rows)


def _failed(result: dict[str, Any]) -> str:
    return str(len(result["failures"]))


def loads() -> str:
    """Make the table of large captures and splats: the memory that they took, and the bound that was stated."""
    rows = []
    for name, found in _read("load.json")["cases"].items():
        size = f"{found['width']} x {found['height']}"
        rows.append([name, size, f"{found['peak_gib']:.2f} GiB", f"{found['bound_gib']:.2f} GiB", found["backend"]])
    return _table(["load", "photograph or render, px", "peak", "bound", "backend"], ["---"] * 5, rows)


def _read(name: str) -> dict[str, Any]:
    return dict(json.loads((RESULTS / name).read_text(encoding="utf-8")))


def _table(head: Sequence[str], rule: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, rule, *rows))
