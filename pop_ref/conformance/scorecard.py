"""The scorecard: which laws a backend obeys, by stage, and how much of it they have reached; as JSON or as a page."""

from __future__ import annotations

import contextlib
import json
import os
import platform
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pop_ref.conformance.capabilities import STAGES


@dataclass
class Entry:
    """One law over one backend.

    Attributes:
        backend, stage, law: names.
        outcome: passed, failed, skipped; or crashed, where the backend raised an error, so that nothing was compared.
        detail: the first line of the failure, or why it was skipped.
        seconds: how long it took.
        differences: of a failure, what differs first and where, a line each.
        cpu: seconds of this process; a program that is judged has its own beside.
    """

    backend: str
    stage: str
    law: str
    outcome: str
    detail: str
    seconds: float
    differences: tuple[str, ...] = ()
    cpu: float = 0.0


@dataclass
class Scorecard:
    """Every law that was run.

    Attributes:
        title: what was judged.
        entries: in the order in which they ran.
        surfaces: by backend, what of it laws can reach (`surface.surface_of`).
        pairs: by backend, which pairs of arguments were compared (`pairs.judged_pairs`).
    """

    title: str
    entries: list[Entry] = field(default_factory=list)
    surfaces: dict[str, dict[str, Any]] = field(default_factory=dict)
    pairs: dict[str, dict[str, Any]] = field(default_factory=dict)

    def summary(self) -> dict[str, dict[str, dict[str, int]]]:
        """Count outcomes by backend and stage, stages in the order of a render; a crash is a failure, counted apart."""
        counts: dict[str, dict[str, dict[str, int]]] = {}
        for entry in sorted(self.entries, key=lambda e: STAGES.index(e.stage)):
            row = counts.setdefault(entry.backend, {}).setdefault(entry.stage, {"passed": 0, "failed": 0, "skipped": 0})
            if entry.outcome == "crashed":
                row["crashed"] = row.get("crashed", 0) + 1
            row["failed" if entry.outcome == "crashed" else entry.outcome] += 1
        return counts

    def write(self, path: Path) -> None:
        """Write JSON, or a page if the name ends in .html."""
        from pop_ref.conformance.scorecard_page import page

        text = page(self, versions()) if path.suffix == ".html" else _compact(self.as_dict())
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")

    def as_dict(self) -> dict[str, Any]:
        """Return what the JSON file holds: counts, and by backend, stage and outcome the names of laws.

        An outcome is passed, "skipped: REASON", "failed: DETAIL" or "crashed: DETAIL".
        """
        laws: dict[str, dict[str, dict[str, list[str]]]] = {}
        for entry in sorted(self.entries, key=lambda e: STAGES.index(e.stage)):
            outcome = f"{entry.outcome}: {entry.detail}" if entry.detail else entry.outcome
            of_stage = laws.setdefault(entry.backend, {}).setdefault(entry.stage, {})
            of_stage.setdefault(outcome, []).append(entry.law)
        made: dict[str, Any] = {**versions(), "seconds": round(sum(entry.seconds for entry in self.entries))}
        cpu = {b: round(sum(e.cpu for e in self.entries if e.backend == b)) for b in laws}
        made |= {"cpu seconds": cpu} if any(cpu.values()) else {}
        return {
            "title": self.title,
            "made": made,
            "surface": self.surfaces,
            "pairs": self.pairs,
            "summary": self.summary(),
            "laws": laws,
        }


def outcomes(of_stage: dict[str, list[str]]) -> dict[str, str]:
    """Return the outcome of each law of a stage, as a scorecard's JSON holds them."""
    return {law: outcome for outcome, laws in of_stage.items() for law in laws}


def _compact(card: dict[str, Any]) -> str:
    """Write JSON with a line for each stage of each backend."""
    lines = []
    for key, value in card.items():
        if key not in ("summary", "laws", "surface", "pairs"):
            lines.append(f" {json.dumps(key)}: {json.dumps(value)}")
            continue
        parts = []
        for backend, rows in value.items():
            inner = ",\n".join(f"   {json.dumps(name)}: {json.dumps(row)}" for name, row in rows.items())
            parts.append(f"  {json.dumps(backend)}: {{\n{inner}\n  }}")
        lines.append(f" {json.dumps(key)}: {{\n" + ",\n".join(parts) + "\n }")
    return "{\n" + ",\n".join(lines) + "\n}"


def versions() -> dict[str, str]:
    """Return what the laws ran with: how many examples, and the versions of what is installed."""
    found = {"hypothesis profile": os.environ.get("HYPOTHESIS_PROFILE", "dev"), "python": platform.python_version()}
    for package in ("pop-splatting", "numpy", "hypothesis", "torch", "gsplat", "diff-gaussian-rasterization"):
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
