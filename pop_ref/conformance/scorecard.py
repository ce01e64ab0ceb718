"""The scorecard: which laws a backend obeys, by stage, as JSON or as a page."""

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
        outcome: passed, failed or skipped.
        detail: the first line of the failure, or why it was skipped.
        seconds: how long it took.
        told: of a failure, what differs first and where, a line each.
    """

    backend: str
    stage: str
    law: str
    outcome: str
    detail: str
    seconds: float
    told: tuple[str, ...] = ()


@dataclass
class Scorecard:
    """Every law that was run.

    Attributes:
        title: what was judged.
        entries: in the order in which they ran.
    """

    title: str
    entries: list[Entry] = field(default_factory=list)

    def summary(self) -> dict[str, dict[str, dict[str, int]]]:
        """Count outcomes by backend and stage, stages in the order of a render."""
        counts: dict[str, dict[str, dict[str, int]]] = {}
        for entry in sorted(self.entries, key=lambda e: STAGES.index(e.stage)):
            row = counts.setdefault(entry.backend, {}).setdefault(entry.stage, {"passed": 0, "failed": 0, "skipped": 0})
            row[entry.outcome] += 1
        return counts

    def write(self, path: Path) -> None:
        """Write JSON, or a page if the name ends in .html."""
        from pop_ref.conformance.scorecard_page import page

        text = page(self) if path.suffix == ".html" else json.dumps(self.as_dict(), indent=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")

    def as_dict(self) -> dict[str, Any]:
        """Return what the JSON file holds: counts, and by backend and stage what came of each law."""
        laws: dict[str, dict[str, dict[str, str]]] = {}
        for entry in sorted(self.entries, key=lambda e: STAGES.index(e.stage)):
            told = f"{entry.outcome}: {entry.detail}" if entry.detail else entry.outcome
            laws.setdefault(entry.backend, {}).setdefault(entry.stage, {})[entry.law] = told
        seconds = round(sum(entry.seconds for entry in self.entries))
        made = {**versions(), "seconds": seconds}
        return {"title": self.title, "made": made, "summary": self.summary(), "laws": laws}


def versions() -> dict[str, str]:
    """Return what the laws ran with: how many examples, and the versions of what is installed."""
    found = {"hypothesis profile": os.environ.get("HYPOTHESIS_PROFILE", "dev"), "python": platform.python_version()}
    for package in ("pop-splatting", "numpy", "hypothesis", "torch", "gsplat", "diff-gaussian-rasterization"):
        with contextlib.suppress(PackageNotFoundError):
            found[package] = version(package)
    return found
