"""The tables of README.md and of the pages in docs/, which are made from the sources and from runs.

python docs/tables.py            print them
python docs/tables.py --write    put them into their pages, between their marks, and write docs/MUTANTS.md
python docs/tables.py --check    exit with 1 when a page holds something else
"""

from __future__ import annotations

import json
import re
import runpy
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import kit_tables
from kit_tables import MUTANT_LIST, table
from stages import ROOT, STAGES, files, functions, laws

from paper_repro.claims_page import outcome as outcome_of
from paper_repro.methods import load_pinned
from paper_repro.status import everything, status_table
from pop_fast.train.presets import METHODS, options_for
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER, SPEEDY_SPLAT
from pop_ref.notation import SYMBOLS
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES

README = ROOT / "README.md"
PAGES = (README, *sorted(path for path in (ROOT / "docs").glob("*.md") if path.name != "MUTANTS.md"))
CPU_TIMES = ROOT / "benchmarks" / "results" / "cpu.json"


def rosetta() -> str:
    """Make the table of stages: the same names in every room; a raised T marks functions that have a transpose."""
    rows = []
    for stage in STAGES:
        names = [name for path in files("pop_ref", stage) for name in functions(path)]
        shown = [f"`{name}`" + ("ᵀ" if f"{name}_vjp" in names else "") for name in names if not name.endswith("_vjp")]
        places = [_links(files(room, stage)) for room in ("pop_ref", "pop_fast", "cuda_ext/csrc")]
        rows.append([stage.title, stage.paper, ", ".join(shown), *places, _links(laws(stage))])
    return table(["stage", "paper", "functions", "`pop_ref`", "`pop_fast`", "`cuda_ext`", "laws"], rows)


def conventions() -> str:
    """Make the table of symbols from `pop_ref.notation`."""
    rows = [[f"`{s.name}`", s.shape, s.unit, s.frame, f"${s.paper}$" if s.paper else "", s.meaning] for s in SYMBOLS]
    return table(["name", "shape", "unit", "frame", "paper", "meaning"], rows)


def profiles() -> str:
    """Make the table of constants by profile from `pop_ref.constants`."""
    named = (PAPER, GSPLAT_1_5, GSPLAT_1_6, INRIA, SPEEDY_SPLAT)

    def stop(inclusive: bool, value: float) -> str:
        return f"T {'≤' if inclusive else '<'} {value:g}"

    lines: list[tuple[str, Callable[..., str]]] = [
        ("near plane", lambda p: f"z {'≤' if p.near_inclusive else '<'} {p.near_plane:g}"),
        ("extent", lambda p: f"{p.extent.replace('_', '-')}, {p.extent_sigmas:g} sigma"),
        ("alpha ceiling, its gradient", lambda p: f"{p.alpha_ceiling:g}, {p.ceiling_gradient}"),
        ("alpha floor", lambda p: f"1/{1 / p.alpha_floor:.0f}"),
        ("a pixel stops at", lambda p: stop(p.stop_inclusive, p.transmittance_stop)),
        ("principal point", lambda p: p.principal_point),
        ("gradient of the frustum clamp", lambda p: p.clamp_gradient),
    ]
    return table(["", *(f"`{p.name}`" for p in named)], [[title, *map(show, named)] for title, show in lines])


def recipes() -> str:
    """Make the table of the paper's rows as options of `pop train`, from `pop_ref.recipes`."""
    rows = [[name, f"`pop train scene {' '.join(options_for(recipe))}`".replace(" `", "`"), RECIPE_NOTES.get(name, "")]
            for name, recipe in (*RECIPES.items(), *BASELINES.items())]  # fmt: skip
    divided = " ".join(options_for(L1_DIVIDED[10]))
    rows.append(["L1 div = 10", f"`pop train scene {divided}`", "and likewise 1, 2, 5, 20, 50, 100"])
    return table(["row of the paper", "command", ""], rows)


RECIPE_NOTES = {
    "POP": "the whole method",
    "L2": "the module ablation's first row: no blur rule, no POP term, no reset",
    "Reset": "opacity reset in place of the POP term",
    "3DGS": "Inria's code, with its rasterizer's constants",
    "3DGS 2023": "the same before its opacities moved half as fast; the next four are built on it or on 3DGS",
    "gsplat": "gsplat's default strategy",
    "PUP-3DGS": "two rounds of pruning by Fisher blocks and refining, after a whole training",
    "Mini-Splatting": "blur split, depth re-initialization, sampling and pruning by importance",
    "Taming-3DGS": "growth to a budget, by sampling from a score",
    "Speedy-Splat": "exact tile lists, soft and hard pruning by sensitivity",
}


def methods() -> str:
    """Make a table a method: every setting that decides a training, its value, and where its source says so."""
    parts = []
    for name in METHODS:
        pinned = load_pinned(name)
        rows = [_cited(setting, of) for setting, of in pinned.settings.items()]
        differing = {**{f"row {row}": of for row, of in pinned.rows.items()}, **pinned.scenes}
        rows += [_cited(f"{where}: {setting}", one) for where, of in differing.items() for setting, one in of.items()]
        order = [_cited(kind, (" · ".join(events), source)) for kind, (events, source) in pinned.order.items()]
        read = "".join(f"- {source}\n" for source in pinned.sources)
        settings = table(["setting", "value", "where its source says so"], rows)
        steps = table(["step", "what happens to the Gaussians, in this order", "where"], order)
        parts.append(f"## {name}\n\n{read}\n{settings}\n\n{steps}")
    return "\n\n".join(parts)


def _cited(name: str, of: tuple[Any, str]) -> list[str]:
    value, source = of
    return [f"`{name}`", "none" if value is None else str(value), source]


def reproduction() -> str:
    """Make the table of the paper's claims and tables, as `paper_repro.status` does."""
    return status_table(everything())


def outcome() -> str:
    """Tell what became of the paper's headline claims, a line each, as `paper_repro.status` does."""
    return outcome_of(everything())


def results() -> str:
    """Make the table of training runs, as benchmarks/results_table.py does."""
    return str(runpy.run_path(str(ROOT / "benchmarks" / "results_table.py"))["table"]())


def summary() -> str:
    """Make README's short table of training runs, as benchmarks/results_table.py does."""
    return str(runpy.run_path(str(ROOT / "benchmarks" / "results_table.py"))["summary"]())


def differences() -> str:
    """Make the table of POP less gsplat's strategy, as benchmarks/results_table.py does."""
    return str(runpy.run_path(str(ROOT / "benchmarks" / "results_table.py"))["differences"]())


def few_photographs() -> str:
    """Make the table of captures with few photographs left, as benchmarks/few_photographs.py does."""
    script = runpy.run_path(str(ROOT / "benchmarks" / "few_photographs.py"))
    known = json.loads((ROOT / "benchmarks" / "results" / "few_photographs.json").read_text(encoding="utf-8"))
    return str(script["table_of"](known, ("--depth-lambda 0.1", "--depth-lambda 0.01", "--method gsplat")))


def estimates() -> str:
    """Make the table of what runs without a preset foretold and took, as benchmarks/estimates.py does."""
    known = json.loads((ROOT / "benchmarks" / "results" / "estimates.json").read_text(encoding="utf-8"))
    machine = known["machine"]
    made = str(runpy.run_path(str(ROOT / "benchmarks" / "estimates.py"))["table_of"](known))
    return f"{made}\n\n{machine['cpu']}, one thread, commit {machine['commit']}."


def _of_faults(name: str) -> Callable[[], str]:
    """Make a table as benchmarks/fault_tables.py does."""
    return lambda: str(runpy.run_path(str(ROOT / "benchmarks" / "fault_tables.py"))[name]())


def blocks() -> str:
    """Make the table of a capture whole and in blocks, as benchmarks/blocks.py does."""
    return str(runpy.run_path(str(ROOT / "benchmarks" / "blocks.py"))["table"]())


def speed() -> str:
    """Make the tables of CPU times, those of a row taken in turns in one process: training steps, renders, blends."""
    timed = json.loads(CPU_TIMES.read_text(encoding="utf-8"))
    machine = timed["machine"]
    make = runpy.run_path(str(ROOT / "benchmarks" / "step_tables.py"))["steps"]
    made, rows = [str(make(timed))], []
    for case in timed["raster"]:
        rows.append(_speed_row(f"render, {_size(case)}", case["forward_ms"]))
        rows.append(_speed_row(f"render and backward, {_size(case)}", case["forward_backward_ms"]))
        for blend in case["blend"]:
            ns = {name: f"{value:.1f} ns a pair" for name, value in blend["forward_backward_ns_per_pair"].items()}
            ratio = blend["forward_backward_ms"]["compiled / fast"]
            what = f"blend and backward alone, {_size(case)}, {blend['tile']} px tiles"
            rows.append([what, ns["fast"], ns["compiled"], f"{ratio:.2f}"])
    made.append(table(["", "`fast`", "`compiled`", "ratio of times"], rows))
    made.append(f"{machine['cpu']}, {machine['capability']}, {machine['threads']} threads, torch {machine['torch']}.")
    return "\n\n".join(made)


def _size(case: dict[str, Any]) -> str:
    return f"{case['width']}x{case['height']}, {case['n']:,} Gaussians"


def _speed_row(what: str, ms: dict[str, float]) -> list[str]:
    return [what, f"{ms['fast']:.0f} ms", f"{ms['compiled']:.0f} ms", f"{ms['compiled / fast']:.2f}"]


TABLES: dict[str, Callable[[], str]] = {
    "rosetta": rosetta,
    "conventions": conventions,
    "profiles": profiles,
    "speed": speed,
    "summary": summary,
    "results": results,
    "differences": differences,
    "few_photographs": few_photographs,
    "estimates": estimates,
    **{name: _of_faults(name) for name in ("fuzzed", "disturbed", "sanitized", "loads")},
    "blocks": blocks,
    "recipes": recipes,
    "methods": methods,
    "reproduction": reproduction,
    "settled": outcome,
    "outcome": outcome,
    "kit": kit_tables.kit,
    "teeth": kit_tables.teeth,
    "scorecards": kit_tables.scorecards,
    "surfaces": kit_tables.surfaces,
    "power": kit_tables.power,
    "reached": kit_tables.reached,
    "broken": kit_tables.broken_laws,
}


def names_of(text: str) -> list[str]:
    """Give the names of the tables that a page has marks for, `<!-- NAME:begin -->` and `<!-- NAME:end -->`."""
    return re.findall(r"<!-- (\w+):begin -->", text)


def with_tables(page: Path) -> str:
    """Give the text of a page with every table between its marks; links lead from where the page lies.

    Raises:
        ValueError: the page has a mark of no table, or a beginning without an end.
    """
    text = page.read_text(encoding="utf-8")
    up = "../" * (len(page.relative_to(ROOT).parts) - 1)
    for name in names_of(text):
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        before, _, rest = text.partition(begin)
        _, found, after = rest.partition(end)
        if not found or name not in TABLES:
            raise ValueError(f"{page}: {begin} needs {end} after it and one of the names {', '.join(TABLES)}")
        made = re.sub(r"\]\((?!https?:|#)", f"]({up}", TABLES[name]())
        text = f"{before}{begin}\n{made}\n{end}{after}"
    return text


def _links(paths: Iterable[Path]) -> str:
    found = dict.fromkeys(paths)
    return ", ".join(f"[{path.name}]({path.relative_to(ROOT).as_posix()})" for path in found) or "–"


def main(words: list[str]) -> int:
    """Run the script."""
    if "--write" not in words and "--check" not in words:
        print("\n\n".join(make() for make in TABLES.values()))
        return 0
    if "--write" in words:
        for page in PAGES:
            page.write_text(with_tables(page), encoding="utf-8")
        MUTANT_LIST.write_text(f"{kit_tables.mutants()}\n", encoding="utf-8")
        return 0
    stale = [page.name for page in PAGES if with_tables(page) != page.read_text(encoding="utf-8")]
    stale += [MUTANT_LIST.name] if MUTANT_LIST.read_text(encoding="utf-8") != f"{kit_tables.mutants()}\n" else []
    for name in stale:
        print(f"{name}: a table is not what sources and runs say; run 'python docs/tables.py --write'")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
