"""The tables of what the kit holds and notices: laws, mutants, scorecards, teeth, reach.

`tables.py` puts them into the pages. Runs are read from `benchmarks/results`; `make kit` makes them again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from typing import Any

from stages import ROOT

from pop_ref.conformance.capabilities import STAGES
from pop_ref.conformance.law_coverage import LIMITS, reason
from pop_ref.conformance.mutants import BLACK_BOXES, FAMILIES, MUTANTS, PROGRAM
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.scorecard import outcomes
from pop_ref.conformance.teeth import UNITS

MUTANT_LIST = ROOT / "docs" / "MUTANTS.md"
CARDS = ROOT / "benchmarks" / "results" / "scorecards"
TEETH = ROOT / "benchmarks" / "results" / "teeth.json"
LAW_COVERAGE = ROOT / "benchmarks" / "results" / "law_coverage.json"
KILLS = ROOT / "benchmarks" / "results" / "kills.json"
VECTOR_KILLS = ROOT / "benchmarks" / "results" / "vector_kills.json"
# the judged, in the order of their columns, and the card that each stands on
JUDGED = {
    "pop_fast float64": ("pop_fast.json", "fast64"),
    "pop_fast float32": ("pop_fast.json", "fast32"),
    "compiled float64": ("compiled.json", "compiled64"),
    "compiled float32": ("compiled.json", "compiled32"),
    "gsplat torch float64": ("gsplat.json", "gsplat-torch64"),
    "gsplat torch float32": ("gsplat.json", "gsplat-torch32"),
}

OURS = {title: judged for title, judged in JUDGED.items() if not title.startswith("gsplat")}

MUTANT_HEAD = """# Mutants

Made by `python docs/tables.py --write`; a test holds it to the code.

{n} copies of the oracle and {programs} of the program that trains, each with one line broken as somebody once broke it.
A kit that lets one live is not worth its time, so for each a law is named that breaks on it within the `ci` profile;
`tests/meta/test_mutants.py` tries them all. `python -m pop_ref.conformance.mutants` puts them on trial again, `--every`
lists all laws that notice.

"""

BOX_HEAD = """

## Behind gsplat's signature

{n} rasterizers that draw one small view rightly and break one argument around it, or two together, judged as any
`--rasterizer` is: by what they return alone.

"""


def kit() -> str:
    """Say how much the kit holds."""
    where = f"[{MUTANT_LIST.name}]({MUTANT_LIST.relative_to(ROOT).as_posix()})"
    return (
        f"{len(every_law())} laws in {len(STAGES)} stages; {len(MUTANTS)} mutants of the oracle and {len(PROGRAM)} "
        f"of the program that trains, and {len(BLACK_BOXES)} rasterizers that break arguments, every one of them "
        f"killed by a named law within the `ci` profile: {where}."
    )


def scorecards() -> str:
    """Make the table of what the kit found: rows are stages, cells say laws passed, failed and skipped."""
    columns = [card(file)["summary"][backend] for file, backend in JUDGED.values()]
    rows = [[stage, *(_counts(column[stage]) for column in columns)] for stage in STAGES]
    total = [{key: sum(column[s][key] for s in STAGES) for key in column[STAGES[0]]} for column in columns]
    head = ["stage", *JUDGED]
    return table(head, [*rows, ["**all**", *(f"**{_counts(count)}**" for count in total)]])


def _counts(count: dict[str, int]) -> str:
    if not count["passed"] + count["failed"]:
        return f"– ({count['skipped']})"
    broken = f", {count['failed']} broken" if count["failed"] else ""
    return f"{count['passed']}{broken}" + (f" ({count['skipped']})" if count["skipped"] else "")


def card(file: str) -> dict[str, Any]:
    """Read a scorecard."""
    return dict(json.loads((CARDS / file).read_text(encoding="utf-8")))


def broken_laws() -> str:
    """List the laws that a judged backend breaks."""
    lines = []
    for title, (file, backend) in JUDGED.items():
        for of_stage in card(file)["laws"][backend].values():
            names = [law for law, came in outcomes(of_stage).items() if came.startswith("failed")]
            lines += [f"- {title}: {law.replace('_', ' ')}" for law in names]
    return "\n".join(lines) or "None is broken."


def surfaces() -> str:
    """Make the table of how much of each judged backend the laws reach, and of what they cost."""
    rows = []
    for title, (file, backend) in JUDGED.items():
        told = card(file)
        surface, counts, cpu = told["surface"][backend], told["summary"][backend].values(), told["made"]["cpu seconds"]
        tried, every = sum(c["passed"] + c["failed"] for c in counts), sum(sum(c.values()) for c in counts)
        groups = [surface[group] for group in ("whole views", "arguments", "stage functions")]
        reached = [f"{len(g['offered'])} of {len(g['offered']) + len(g['not'])}" for g in groups]
        rows.append([title, f"{tried} of {every}", str(cpu[backend]), surface["profile"], *reached])
    head = ["", "laws tried", "CPU seconds", "constants", "of whole views", "of gsplat's arguments", "stage functions"]
    return table(head, rows)


def power() -> str:
    """Make the table of what the kit kills, and of sound backends that it refuses."""
    laws, vectors = (json.loads(path.read_text(encoding="utf-8")) for path in (KILLS, VECTOR_KILLS))
    rows = []
    for family in FAMILIES:
        count = len(laws[family])
        killed = sum(None not in of.values() for of in laws[family].values())
        noticed = sum(first is not None for first in vectors[family].values())
        rows.append([family, str(count), f"{killed} of {count}", f"{noticed} of {len(vectors[family])}"])
    failed = {title: sum(c["failed"] for c in card(file)["summary"][b].values()) for title, (file, b) in OURS.items()}
    refused = sum(1 for count in failed.values() if count)
    of_vectors = [first for first in vectors["sound"].values() if first is not None]
    sound = f"{refused} of {len(failed)} refused", f"{len(of_vectors)} of {len(vectors['sound'])} refused"
    rows.append(["sound backends of this project", "", *sound])
    return table(
        ["broken on purpose", "mutants", "killed in every precision", "noticed by the portable vectors alone"], rows
    )


def reached() -> str:
    """Make the tables of what laws reach: ranges of arguments, and lines of the oracle that none runs."""
    logged = json.loads(LAW_COVERAGE.read_text(encoding="utf-8"))
    ranges = [[name, f"{low:.3g}", f"{high:.3g}", LIMITS[name]] for name, (low, high) in logged["ranges"].items()]
    choices = [[name, ", ".join(f"`{value}`" for value in values)] for name, values in logged["choices"].items()]
    lines, refusals, others = 0, 0, dict[tuple[str, str], int]()
    for file, found in logged["modules"].items():
        lines += found["lines"]
        for function, _ in found["unreached"]:
            why = reason(file, function)
            refusals += why is None
            if why is not None:
                others[file, why] = others.get((file, why), 0) + 1
    rows = [[f"`{file}`", str(count), why] for (file, why), count in others.items()]
    rows.append(["all", str(refusals), "arguments are refused: tests of the oracle give wrong ones, laws give none"])
    run = lines - refusals - sum(others.values())
    said = f"Of {lines:,} lines in the oracle's functions the laws run {run:,}. The others:"
    return "\n\n".join((
        table(["argument", "least", "largest", "why no further"], ranges),
        table(["argument", "values"], choices),
        said,
        table(["module", "lines not reached", "why"], rows),
    ))  # fmt: skip


def teeth() -> str:
    """Make the table of the smallest errors that the kit notices, and of what sound backends need of its tolerances."""
    kept = json.loads(TEETH.read_text(encoding="utf-8"))
    single, double = kept["float32"], kept["float64"]

    def needed(of: dict[str, dict[str, float]], name: str) -> str:
        share = of["sound"].get(name, of["sound"]["image"])
        return f"{100.0 * share:.2g} %"

    rows = [
        [
            f"`{name}`" if name.startswith("v_") else f"{name}, {UNITS.get(name, 'share of itself')}",
            *(f"{of['teeth'][name]:.1e}" for of in (single, double)),
            *(needed(of, name) for of in (single, double)),
        ]
        for name in single["teeth"]
    ]
    head = ["error in", "float32 notices", "float64 notices", "sound float32 needs", "sound float64 needs"]
    return table(head, rows)


def mutants() -> str:
    """Make the list of mutants: what was broken in which file, and the law that notices."""
    laws = every_law()
    rows = [
        [
            m.name.replace("_", " "),
            m.story.replace("|", "\\|"),
            f"`{m.package}/{m.file}`",
            laws[m.law].stage,
            m.law.partition(":")[2].replace("_", " "),
        ]
        for m in (*MUTANTS, *PROGRAM)
    ]
    head = MUTANT_HEAD.format(n=len(MUTANTS), programs=len(PROGRAM))
    boxes = [[b.name.replace("_", " "), b.story, b.law.partition(":")[2].replace("_", " ")] for b in BLACK_BOXES]
    return "".join(
        (
            head,
            table(["mutant", "what happened", "file", "stage", "killed by"], rows),
            BOX_HEAD.format(n=len(BLACK_BOXES)),
            table(["black box", "what it does", "killed by"], boxes),
        )
    )


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Make a Markdown table."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows))
