"""The scorecard: which laws a backend obeys, by stage, and how much of it they can reach; as JSON or as a page."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from pop_ref.conformance.capabilities import DOMINANCE, GRADIENTS, RENDER, SIGNATURE, STAGES, WHOLE
from pop_ref.conformance.files import write_file
from pop_ref.conformance.law import missing
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.views import ASKED


@dataclass
class Entry:
    """One law over one backend.

    Attributes:
        backend, stage, law: names.
        outcome: passed, failed, skipped; or crashed, where the backend raised an error, so that nothing was compared.
        detail: the first line of the failure, or why it was skipped.
        seconds: how long it took.
        differences: of a failure, what differs first and where, a line each.
        cpu: seconds of this process; a judged program has its own besides.
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
        surfaces: by backend, what of it laws can reach (`surface_of`).
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
        text = page(self, versions()) if path.suffix == ".html" else _compact(self.as_dict())
        write_file(path, text + "\n")

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


def page(card: Scorecard, made_with: Mapping[str, str]) -> str:
    """Return the page."""
    made = ", ".join(f"{name} {value}" for name, value in made_with.items())
    parts = [_HEAD.format(title=escape(card.title)), f"<p class=made>{escape(made)}</p>"]
    for backend, stages in card.summary().items():
        chosen = [entry for entry in card.entries if entry.backend == backend]
        parts += [f"<section><h2>{escape(backend)}</h2>", _verdict(chosen)]
        parts += [_surface(card.surfaces.get(backend, {})), _table(stages)]
        parts += [*_broken(chosen), *_pairs(card.pairs.get(backend, {})), *_skipped(chosen), "</section>"]
    return "\n".join(parts)


def _count(entries: list[Entry], outcome: str) -> int:
    return sum(entry.outcome == outcome for entry in entries)


def _verdict(entries: list[Entry]) -> str:
    passed, crashed, skipped = (_count(entries, outcome) for outcome in ("passed", "crashed", "skipped"))
    failed = _count(entries, "failed") + crashed
    if not passed + failed:
        return "<p>Nothing could be judged.</p>"
    words = f"breaks {failed} of {passed + failed} laws" if failed else f"obeys all {passed} laws that could be tried"
    words += f", {crashed} of them by errors of its own" if crashed else ""
    return f"<p class={'bad' if failed else 'good'}>{words}; {skipped} skipped</p>"


def _surface(surface: dict[str, Any]) -> str:
    if not surface:
        return ""
    lines = [f"Constants: {surface['profile']}; precision: {surface['dtype']}."]
    for group in ("whole views", "arguments", "stage functions"):
        offered, lacks = surface[group]["offered"], surface[group]["not"]
        lines.append(f"Reached of {group}: {len(offered)} of {len(offered) + len(lacks)}.")
        lines += [f"Not reached: {', '.join(lacks)}."] if lacks else []
    return "<p class=made>" + "<br>".join(map(escape, lines)) + "</p>"


def _table(stages: dict[str, dict[str, int]]) -> str:
    rows = []
    for stage, count in stages.items():
        judged = count["passed"] + count["failed"]
        kind = "bad" if count["failed"] else "good" if judged else "none"
        share = 100.0 * count["passed"] / judged if judged else 0.0
        bar = f'<span class=bar><i style="width:{share:.0f}%"></i></span>' if judged else ""
        cells = (f"{count['passed']} of {judged}" if judged else "–", count["failed"] or "", count["skipped"] or "")
        rows.append(f"<tr class={kind}><th>{stage}<td>{bar}" + "".join(f"<td class=n>{cell}" for cell in cells))
    head = "<tr><th>stage<th><th class=n>obeyed<th class=n>broken<th class=n>skipped"
    return f"<table>{head}{''.join(rows)}</table>"


def _broken(entries: list[Entry]) -> list[str]:
    failed = [entry for entry in entries if entry.outcome in ("failed", "crashed")]
    parts = ["<h3>Broken</h3>"] if failed else []
    for entry in failed:
        lines = "".join(f"<li>{escape(line)}" for line in entry.differences)
        parts.append(
            f"<article><b>{_sentence(entry.law)}</b> <small>{entry.stage}, {entry.outcome}</small>"
            f"<p>{escape(entry.detail)}</p><ul>{lines}</ul></article>"
        )
    return parts


def _pairs(pairs: dict[str, Any]) -> list[str]:
    if not pairs:
        return []
    head = f"Pairs of arguments compared: {pairs['judged']} of {pairs['taken']}, in {pairs['calls']} calls"
    rows = [f"<dt>refused alone: {escape(what)}<dd>{escape(why)}" for what, why in pairs["refused alone"].items()]
    rows += [f"<dt>not compared, as every call with them fails<dd>{escape(pair)}" for pair in
             pairs["only in calls that fail"]]  # fmt: skip
    rows += [f"<dt>{escape(names)}<dd>{count}" for names, count in pairs["by arguments"].items()]
    return [f"<details><summary>{head}</summary><dl>{''.join(rows)}</dl></details>"]


def _skipped(entries: list[Entry]) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for entry in entries:
        if entry.outcome == "skipped":
            by_reason.setdefault(entry.detail, []).append(_sentence(entry.law))
    if not by_reason:
        return []
    rows = [
        f"<dt>{escape(reason)}<dd>{'; '.join(laws)}"
        for reason, laws in sorted(by_reason.items(), key=lambda each: -len(each[1]))
    ]
    total = sum(len(laws) for laws in by_reason.values())
    return [f"<details><summary>Skipped: {total}</summary><dl>{''.join(rows)}</dl></details>"]


def _sentence(law: str) -> str:
    return escape(law.replace("_", " "))


_HEAD = """<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content="width=device-width">
<title>{title}</title><style>
:root{{color-scheme:light dark;--ink:#1f2328;--quiet:#6b7280;--line:#d8dce2;--good:#2f8f6b;--bad:#c2403a;--paper:#fff}}
@media(prefers-color-scheme:dark){{:root{{--ink:#e4e7eb;--quiet:#98a1ad;--line:#3a414b;--paper:#16191d}}}}
body{{font:16px/1.5 system-ui,sans-serif;max-width:56rem;margin:2rem auto;padding:0 1rem;
color:var(--ink);background:var(--paper)}}
h1{{font-size:1.4rem;margin-bottom:0}} h2{{font-size:1.15rem;margin:2.2rem 0 .2rem}}
h3{{font-size:1rem;margin-bottom:.3rem}}
.made,small,dd{{color:var(--quiet);font-size:.85rem}} .made{{margin-top:.2rem}}
p.good{{color:var(--good)}} p.bad{{color:var(--bad)}} p.good,p.bad{{font-weight:600;margin:.2rem 0 .6rem}}
table{{border-collapse:collapse}} th{{font-weight:400;text-align:left}} tr:first-child th{{color:var(--quiet)}}
td,th{{padding:.18rem .8rem .18rem 0;border-bottom:1px solid var(--line)}} .n{{text-align:right;min-width:4.5rem}}
.none th,.none td{{color:var(--quiet)}} .bad .n:nth-child(4){{color:var(--bad);font-weight:600}}
.bar{{display:inline-block;width:9rem;height:.55rem;background:var(--bad);border-radius:2px;overflow:hidden}}
.bar i{{display:block;height:100%;background:var(--good)}}
article{{border-left:3px solid var(--bad);padding:.1rem 0 .1rem .8rem;margin:.7rem 0}}
article p,article li{{font:.82rem/1.45 ui-monospace,monospace;overflow-wrap:anywhere;margin:.2rem 0}}
article ul{{padding-left:1.1rem;margin:.2rem 0}} details{{margin-top:1rem}}
dt{{margin-top:.5rem}} dd{{margin-left:1rem}}
</style><h1>{title}</h1>"""


def introduction(backend: Any, of_options: bool = False) -> list[str]:
    """Return the lines that a session begins with: what is judged, as what, by how many laws, and what is not.

    Args:
        backend: an adapter, or an `Absent`.
        of_options: whether options say its precision, constants and device.
    """
    if hasattr(backend, "reason"):
        return [f"conformance: {backend.name} is not judged: {backend.reason}"]
    laws = list(every_law().values())
    as_what = [np.dtype(backend.dtype).name, f"constants {backend.profile.name if backend.profile else 'any'}"]
    degree = getattr(backend, "sh_degree", 3)
    as_what += [f"harmonics up to degree {degree}"] if degree < 3 else []
    as_what += [f"on {backend.device}"] if hasattr(backend, "device") else []
    otherwise = " (--dtype, --profile, --device say otherwise)" if of_options and backend.profile else ""
    lines = [f"conformance: {backend.name}, {', '.join(as_what)}{otherwise}"]
    judged = [law for law in laws if not missing(backend, law.needs)]
    lines.append(f"  judged: {len(judged)} of {len(laws)} laws, of {_listed({law.stage for law in judged})}")
    if backend.has(SIGNATURE):
        taken = [need for need in ASKED if backend.has(need)]
        lines.append(f"  arguments taken: {'; '.join(taken) or 'none'}")
        lines += [f"  refused, and not judged: {need} ({words})" for need in ASKED if (words := backend.why_not(need))]
    idle = {law.stage for law in laws} - {law.stage for law in judged}
    if idle:
        lines.append(
            f"  no law of {_listed(idle)}: --stages, --adapter and --strategy name an implementation that offers them"
        )
    lines.append("  next: a broken law prints where, and a scene or call to paste; --scorecard card.html tells of all")
    return [part for line in lines for part in textwrap.wrap(line, 110, subsequent_indent="    ")]


def _listed(stages: set[str]) -> str:
    return ", ".join(stage for stage in STAGES if stage in stages) or "nothing"


def stage_functions() -> list[str]:
    """Return the names of the stage functions that laws need."""
    needs = {need for law in every_law().values() for need in law.needs}
    return sorted(need for need in needs if need.isidentifier() and need not in (RENDER, GRADIENTS, DOMINANCE))


def surface_of(backend: Any) -> dict[str, Any]:
    """Return what a backend offers and what it does not, as a scorecard states it.

    Args:
        backend: an adapter, or an `Absent`.

    Returns:
        Constants and precision; of whole views, of gsplat's arguments and of stage functions, those offered and those
        not. Empty for an `Absent`.
    """
    if hasattr(backend, "reason"):
        return {}
    groups = {"whole views": WHOLE, "arguments": (SIGNATURE, *ASKED), "stage functions": stage_functions()}
    found: dict[str, Any] = {
        "profile": backend.profile.name if backend.profile else "any",
        "dtype": np.dtype(backend.dtype).name,
    }
    for group, needs in groups.items():
        offered = [need for need in needs if backend.has(need)]
        found[group] = {"offered": offered, "not": [need for need in needs if need not in offered]}
    return found
