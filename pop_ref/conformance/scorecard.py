"""The scorecard: which laws a backend obeys, by stage, as JSON or as a page."""

from __future__ import annotations

import html
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pop_ref.conformance.law import STAGES


@dataclass
class Entry:
    """One law over one backend.

    Attributes:
        backend, stage, law: names.
        outcome: passed, failed or skipped.
        detail: the first line of the failure, or why it was skipped.
        seconds: how long it took.
    """

    backend: str
    stage: str
    law: str
    outcome: str
    detail: str
    seconds: float


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
        text = self.as_page() if path.suffix == ".html" else json.dumps(self.as_dict(), indent=1)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")

    def as_dict(self) -> dict[str, Any]:
        """Return what the JSON file holds."""
        return {"title": self.title, "summary": self.summary(), "laws": [asdict(entry) for entry in self.entries]}

    def as_page(self) -> str:
        """Return a page that needs nothing else: a table a backend, stages as rows, and the failures below it."""
        parts = [_HEAD.format(title=html.escape(self.title))]
        for backend, stages in self.summary().items():
            parts.append(
                f"<h2>{html.escape(backend)}</h2><table><tr><th>stage<th>laws obeyed<th>broken<th>skipped</tr>"
            )
            for stage, count in stages.items():
                judged = count["passed"] + count["failed"]
                kind = "bad" if count["failed"] else "none" if not judged else "good"
                parts.append(
                    f"<tr class={kind}><td>{stage}<td>{count['passed']} of {judged}<td>{count['failed'] or ''}"
                    f"<td>{count['skipped'] or ''}</tr>"
                )
            parts.append("</table>")
            parts += self._details(backend)
        return "\n".join(parts)

    def _details(self, backend: str) -> list[str]:
        parts = []
        for outcome, heading in (("failed", "Broken"), ("skipped", "Skipped")):
            chosen = [e for e in self.entries if e.backend == backend and e.outcome == outcome]
            if chosen:
                rows = [f"<li>{_sentence(e.law)} <small>{html.escape(e.detail)}</small></li>" for e in chosen]
                parts += [f"<details><summary>{heading}: {len(chosen)}</summary><ul>", *rows, "</ul></details>"]
        return parts


def _sentence(law: str) -> str:
    return html.escape(law.replace("_", " "))


_HEAD = """<!doctype html><html lang=en><meta charset=utf-8><title>{title}</title><style>
body{{font:16px/1.5 system-ui,sans-serif;max-width:52rem;margin:2rem auto;padding:0 1rem;color:#222}}
table{{border-collapse:collapse}} td,th{{padding:.2rem .9rem;text-align:left;border-bottom:1px solid #ddd}}
.good td:first-child{{border-left:4px solid #2a7}} .bad td:first-child{{border-left:4px solid #c33}}
.none{{color:#888}} small{{color:#777}} h2{{margin-top:2rem}}
</style><h1>{title}</h1>"""
