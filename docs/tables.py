"""The tables of README.md and of the pages in docs/, which are made from the sources and from runs.

python docs/tables.py            print them
python docs/tables.py --write    put them into their pages, between their marks, and write MUTANTS.md and LAWS.md
python docs/tables.py --check    exit with 1 when a page holds something else
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks import blocks as run_in_blocks
from benchmarks import estimates as predictions
from benchmarks import few_photographs as with_few
from benchmarks import kinds as kinds_of_captures
from benchmarks import results_table, sizes
from benchmarks.record import markdown as table
from benchmarks.record import read_json
from paper_repro.jobs import load_row
from paper_repro.methods import load_pinned
from paper_repro.results import Result, read_all
from paper_repro.status import everything, headlines, status_table
from paper_repro.status import outcome as outcome_of
from paper_repro.status import settled as settled_of
from pop_fast.train.presets import METHODS, options_for
from pop_ref.conformance.capabilities import STAGES as KIT_STAGES
from pop_ref.conformance.catalogue import FILE as LAW_LIST
from pop_ref.conformance.catalogue import catalogue
from pop_ref.conformance.law_coverage import LIMITS, digest_of, reason
from pop_ref.conformance.laws import STANDS_IN
from pop_ref.conformance.mutants import BLACK_BOXES, FAMILIES, MUTANTS, PROGRAM
from pop_ref.conformance.mutants.trial import every_law
from pop_ref.conformance.scorecard import outcomes
from pop_ref.conformance.teeth import UNITS
from pop_ref.constants import GSPLAT_1_5, GSPLAT_1_6, INRIA, PAPER, SPEEDY_SPLAT
from pop_ref.notation import SYMBOLS
from pop_ref.recipes import BASELINES, L1_DIVIDED, RECIPES

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = (README, *sorted(path for path in (ROOT / "docs").glob("*.md") if path.name != "MUTANTS.md"))
RESULTS = ROOT / "benchmarks" / "results"
CPU_TIMES = RESULTS / "cpu.json"
MUTANT_LIST = ROOT / "docs" / "MUTANTS.md"
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

This page lists {n} copies of the oracle and {programs} of the program that trains. Each copy has one line broken.
For each the table names a law that fails on it within the `ci` profile, and
`tests/meta/test_mutants.py` tries them all. `python -m pop_ref.conformance.mutants` tries them again, and `--every`
lists all laws that fail.

"""

BOX_HEAD = """

## Behind gsplat's signature

These {n} rasterizers draw one small view correctly, and handle one argument or a combination of two wrongly. They are
judged as any `--rasterizer` is, by their results alone.

"""
RECIPE_NOTES = {
    "POP": "the whole method",
    "L2": "the module ablation's first row: no blur rule, no POP term, no reset",
    "Reset": "opacity reset in place of the POP term",
    "3DGS": "Inria's code, with its rasterizer's constants",
    "3DGS 2023": "Inria's code before it halved the rate of opacities; the next four methods extend it or 3DGS",
    "gsplat": "gsplat's default strategy",
    "PUP-3DGS": "after a whole training, two rounds of pruning by Fisher blocks and refining",
    "Mini-Splatting": "blur split, depth re-initialization, sampling and pruning by importance",
    "Taming-3DGS": "growth to a budget, by sampling from a score",
    "Speedy-Splat": "exact tile lists, soft and hard pruning by sensitivity",
}


@dataclass(frozen=True)
class Stage:
    """A row of the Rosetta table: the modules that hold a step have the same names in each room."""

    title: str
    paper: str
    modules: tuple[str, ...]
    also_fast: tuple[str, ...] = ()  # files of pop_fast under other names, where torch or gsplat's interface sets them
    also_cuda: tuple[str, ...] = ()  # files of cuda_ext/csrc that hold several stages


_SCORES = ("scores.cuh", "scores.cu")

STAGES = (
    Stage("raw parameters to scales, opacities, unit quaternions", "3.1", ("activations",), ("stages/covariance.py",)),
    Stage("covariances from rotations and scales", "3.1", ("covariance",)),
    Stage("spherical harmonics to colour", "3.1", ("harmonics",)),
    Stage("world to camera, near plane", "3.1", ("camera",), ("stages/projection.py",)),
    Stage("projection of means and covariances (EWA)", "3.1", ("projection",)),
    Stage("low-pass, conics, extents, off-screen cull", "3.1", ("footprint",), ("stages/projection.py",)),
    Stage("tile lists in depth order", "3.1", ("tiles",), ("compiled/compositing.py",)),
    Stage("falloff and alpha of one splat at one pixel", "eqs. 1, 11", ("alpha",), ("stages/tile_groups.py",)),
    Stage("blending with early ray termination", "eq. 1", ("compositing", "pixel"), ("compiled/compositing.py",)),
    Stage("dominant Gaussians", "eq. 5", ("dominance",), ("stages/compositing.py",)),
    Stage("a whole view", "eq. 1", ("render", "splatting", "depth"), ("api/rasterize.py", "compiled/compositing.py")),
    Stage("L1, L2, SSIM and both objectives", "eqs. 2, 4, 9", ("losses", "ssim"), ("compiled/losses.py",)),
    Stage("importance mask and POP loss", "eqs. 7, 8", ("polarization",), ("stages/regularizers.py",)),
    Stage("terms for few photographs: sparse depth, mean opacity, mean scale", "–", ("regularizers",)),
    Stage("density control", "eqs. 3, 6", ("density", "density_rows")),
    Stage("Adam and its schedules", "4.1", ("optimizer",), ("train/model.py", "train/schedule.py")),
    Stage("exposure of photographs, random backgrounds", "–", ("appearance",), ("train/appearance.py",)),
    Stage("corrections of cameras", "–", ("refinement",), ("stages/appearance.py",)),
    Stage("one training step", "eq. 9", ("training", "recipes"), ("train/torch_stepper.py",)),
    Stage(
        "sums of weights, pixels and distances over a view",
        "4.2",
        ("contributions",),
        ("compiled/compositing.py",),
        _SCORES,
    ),
    Stage(
        "Speedy-Splat's score", "4.2", ("sensitivity",), ("stages/contributions.py", "compiled/compositing.py"), _SCORES
    ),
    Stage("PUP 3D-GS's score", "4.2", ("fisher",), ("stages/contributions.py", "compiled/compositing.py"), _SCORES),
    Stage(
        "Mini-Splatting's points and importance",
        "4.2",
        ("chord", "mini_splatting"),
        ("stages/contributions.py", "stages/density.py", "compiled/compositing.py"),
        _SCORES,
    ),
    Stage("Taming-3DGS's budget and score", "4.2", ("taming",), ("stages/density.py",)),
    Stage("selection by score, by mass, by draw", "4.2", ("selection",), ("stages/density.py",)),
    Stage("exact tile lists (SnugBox, AccuTile)", "4.2", ("tight_tiles",), ("stages/tiles.py",)),
    Stage("distance of every decision from flipping", "–", ("margins", "magnitudes")),
)

# modules of pop_ref that are data or types, not stages
NOT_STAGES = frozenset(
    {"__init__", "_shapes", "ambiguities", "constants", "notation", "records", "registry", "settings"}
    # whole trainings of the methods, which the laws of strategies and of steps are held to, and what they train
    | {"methods", "scripted", "short_training"}
)
# stages whose laws stand in a file of another name: whole views, and what is tested elsewhere
LAWS_ELSEWHERE = {
    "render": "pop_ref/conformance/laws/test_whole.py",
    "depth": "pop_ref/conformance/laws/test_signature_arguments.py",
    "training": "pop_ref/conformance/laws/test_whole_steps.py",
    "appearance": "pop_ref/conformance/laws/test_few_photographs.py",
    "refinement": "pop_ref/conformance/laws/test_few_photographs.py",
    "regularizers": "pop_ref/conformance/laws/test_few_photographs.py",
    "margins": "tests/oracle/test_margins.py",
}


def functions(path: Path) -> dict[str, list[str]]:
    """Give the public functions of a source file, in order, each with its parameters' names."""
    if not path.is_file():
        return {}
    found = (n for n in ast.parse(path.read_text(encoding="utf-8")).body if isinstance(n, ast.FunctionDef))
    return {f.name: [a.arg for a in (*f.args.args, *f.args.kwonlyargs)] for f in found if f.name[0] != "_"}


def files(room: str, stage: Stage) -> Iterator[Path]:
    """Give the files of a stage in one room, where they exist."""
    suffixes = (".cuh", ".cu") if room == "cuda_ext/csrc" else (".py",)
    folder = ROOT / ("pop_fast/stages" if room == "pop_fast" else room)
    for module in stage.modules:
        for suffix in suffixes:
            path = folder / f"{module}{suffix}"
            if path.is_file():
                yield path
    if room == "pop_fast":
        yield from (ROOT / room / name for name in stage.also_fast)
    if room == "cuda_ext/csrc":
        yield from (ROOT / room / name for name in stage.also_cuda)


def laws(stage: Stage) -> Iterator[Path]:
    """Give the law files of a stage, those of its modules, or the place named in `LAWS_ELSEWHERE`."""
    for module in stage.modules:
        if module in LAWS_ELSEWHERE:
            yield ROOT / LAWS_ELSEWHERE[module]
        folder, named = ROOT / "pop_ref" / "conformance" / "laws", STANDS_IN.get(module, module)
        yield from sorted(folder.glob(f"test_{named}.py"))
        yield from sorted(folder.glob(f"test_{named}_*.py"))


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
    rows.append(["L1 div = 10", f"`pop train scene {divided}`", "also with 1, 2, 5, 20, 50, 100"])
    return table(["row of the paper", "command", ""], rows)


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
    return outcome_of(headlines(everything()))


def settled() -> str:
    """Tell the same with the runs that would decide what is open, as `paper_repro.status` does."""
    return settled_of(headlines(everything()))


# the rows of README.md's table, and its captures with their photographs' size
SHOWN_ROWS = ("pop", "reset", "gsplat", "3dgs", "taming", "speedy_splat", "mini_splatting", "mini_splatting_star",
              "pup", "pup_star")  # fmt: skip
SHOWN_SCENES = {"fox": "fox, 270x480", "bear_512": "bear, 256x256", "bonsai_800": "bonsai, 400x266",
                "garden_512": "garden, 256x256"}  # fmt: skip


def summary() -> str:
    """Make the table of README.md: PSNR and Gaussians at scale small, means over seeds."""
    found = read_all("small")
    rows = []
    for row in SHOWN_ROWS:
        runs = [[r for r in found if (r.row, r.scene) == (row, scene)] for scene in SHOWN_SCENES]
        rows.append([load_row(row).title, *map(_of_seeds, runs)])
    return table(["method", *SHOWN_SCENES.values()], rows, ["---", *["---:"] * len(SHOWN_SCENES)])


def _of_seeds(runs: list[Result]) -> str:
    return f"{fmean(r.psnr for r in runs):.2f} dB, {fmean(r.num_gaussians for r in runs):,.0f}" if runs else "–"


def few_photographs() -> str:
    """Make the table of captures with few photographs left, as benchmarks/few_photographs.py does."""
    settings = ("--depth-lambda 0.1", "--depth-lambda 0.01", "--method gsplat")
    return _with_machine("few_photographs.json", lambda known: with_few.table_of(known, settings))


def kinds() -> str:
    """Make the table of what reports say of captures whose faults are known, as benchmarks/kinds.py does."""
    return _with_machine("kinds.json", kinds_of_captures.table_of)


def estimates() -> str:
    """Make the table of what runs without a preset foretold and took, as benchmarks/estimates.py does."""
    return _with_machine("estimates.json", predictions.table_of)


def _with_machine(name: str, table_of: Callable[[dict[str, Any]], str]) -> str:
    known = read_json(RESULTS / name)
    # a row that was measured again has its own
    machines = [row.get("machine", known["machine"]) for what, row in known.items() if what != "machine"]
    where = dict.fromkeys(f"{machine['cpu']}, one thread, commit {machine['commit']}" for machine in machines)
    return f"{table_of(known)}\n\n{'; '.join(where)}."


def speed() -> str:
    """Make the tables of CPU times, those of a row taken in turns in one process: training steps, renders, blends."""
    timed = read_json(CPU_TIMES)
    machine, made, rows = timed["machine"], [results_table.steps(timed)], []
    for case in timed["raster"]:
        rows.append(_speed_row(f"render, {_size(case)}", case["forward_ms"]))
        rows.append(_speed_row(f"render and backward, {_size(case)}", case["forward_backward_ms"]))
        for blend in case["blend"]:
            ns = {name: f"{value:.1f} ns a pair" for name, value in blend["forward_backward_ns_per_pair"].items()}
            ratio = blend["forward_backward_ms"]["compiled / fast"]
            what = f"blend and backward alone, {_size(case)}, {blend['tile']} px tiles"
            rows.append([what, ns["fast"], ns["compiled"], f"{ratio:.2f}"])
    made.append(table(["", "`fast`", "`compiled`", "ratio of times"], rows))
    where = f"{machine['cpu']}, {machine['capability']}, {machine['threads']} threads, torch {machine['torch']}"
    made.append(f"{where}, commit {machine['commit']}.")
    return "\n\n".join(made)


def _size(case: dict[str, Any]) -> str:
    return f"{case['width']}x{case['height']}, {case['n']:,} Gaussians"


def _speed_row(what: str, ms: dict[str, float]) -> list[str]:
    return [what, f"{ms['fast']:.0f} ms", f"{ms['compiled']:.0f} ms", f"{ms['compiled / fast']:.2f}"]


def kit() -> str:
    """Say how much the kit holds."""
    where = f"[{MUTANT_LIST.name}]({MUTANT_LIST.relative_to(ROOT).as_posix()})"
    return (
        f"{len(every_law())} laws in {len(KIT_STAGES)} stages; {len(MUTANTS)} mutants of the oracle and {len(PROGRAM)} "
        f"of the program that trains, and {len(BLACK_BOXES)} rasterizers that break arguments, every one of them "
        f"killed by a named law within the `ci` profile: {where}."
    )


def scorecards() -> str:
    """Make the table of what the kit found: rows are stages, cells say laws passed, failed and skipped."""
    columns = [card(file)["summary"][backend] for file, backend in JUDGED.values()]
    rows = [[stage, *(_counts(column[stage]) for column in columns)] for stage in KIT_STAGES]
    total = [{key: sum(column[s][key] for s in KIT_STAGES) for key in column[KIT_STAGES[0]]} for column in columns]
    head = ["stage", *JUDGED]
    return table(head, [*rows, ["**all**", *(f"**{_counts(count)}**" for count in total)]])


def _counts(count: dict[str, int]) -> str:
    if not count["passed"] + count["failed"]:
        return f"– ({count['skipped']})"
    broken = f", {count['failed']} broken" if count["failed"] else ""
    return f"{count['passed']}{broken}" + (f" ({count['skipped']})" if count["skipped"] else "")


def card(file: str) -> dict[str, Any]:
    """Read a scorecard."""
    return read_json(RESULTS / "scorecards" / file)


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
    of_laws, vectors = (read_json(RESULTS / f"{name}.json") for name in ("kills", "vector_kills"))
    rows = []
    for family in FAMILIES:
        count = len(of_laws[family])
        killed = sum(None not in of.values() for of in of_laws[family].values())
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
    logged = read_json(RESULTS / "law_coverage.json")
    ranges = [
        [name, *("infinite" if x is None else f"{x:.3g}" for x in of), LIMITS[name]]
        for name, of in logged["ranges"].items()
    ]
    choices = [[name, ", ".join(f"`{value}`" for value in values)] for name, values in logged["choices"].items()]
    lines, refusals, others, changed = 0, 0, dict[tuple[str, str], int](), list[str]()
    for file, found in logged["modules"].items():
        changed += [f"`{file}`"] if digest_of(file) != found["sha256"] else []
        lines += found["lines"]
        for function, _ in found["unreached"]:
            why = reason(file, function)
            refusals += why is None
            if why is not None:
                others[file, why] = others.get((file, why), 0) + 1
    rows = [[f"`{file}`", str(count), why] for (file, why), count in others.items()]
    rows.append(["all", str(refusals), "arguments are refused: tests of the oracle give wrong ones, laws give none"])
    run = lines - refusals - sum(others.values())
    since = f" Changed since that run: {', '.join(changed)}." if changed else ""
    said = f"Of {lines:,} lines in the oracle's functions the laws ran {run:,}.{since} The others:"
    return "\n\n".join((
        table(["argument", "least", "largest", "why no further"], ranges),
        table(["argument", "values"], choices),
        said,
        table(["module", "lines not reached", "why"], rows),
    ))  # fmt: skip


def teeth() -> str:
    """Make the table of the smallest errors that the kit notices, and of what sound backends need of its tolerances."""
    kept = read_json(RESULTS / "teeth.json")
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
    every = every_law()
    rows = [
        [
            m.name.replace("_", " "),
            m.story.replace("|", "\\|"),
            f"`{m.package}/{m.file}`",
            every[m.law].stage,
            m.law.partition(":")[2].replace("_", " "),
        ]
        for m in (*MUTANTS, *PROGRAM)
    ]
    head = MUTANT_HEAD.format(n=len(MUTANTS), programs=len(PROGRAM))
    boxes = [[b.name.replace("_", " "), b.story, b.law.partition(":")[2].replace("_", " ")] for b in BLACK_BOXES]
    of_mutants = table(["mutant", "what happened", "file", "stage", "killed by"], rows)
    of_boxes = table(["black box", "what it does", "killed by"], boxes)
    return f"{head}{of_mutants}{BOX_HEAD.format(n=len(BLACK_BOXES))}{of_boxes}\n"


# pages that are made as a whole
LISTS: dict[Path, Callable[[], str]] = {MUTANT_LIST: mutants, LAW_LIST: catalogue}
TABLES: dict[str, Callable[[], str]] = {
    "rosetta": rosetta,
    "conventions": conventions,
    "profiles": profiles,
    "speed": speed,
    "summary": summary,
    "few_photographs": few_photographs,
    "estimates": estimates,
    "kinds": kinds,
    **{name: getattr(results_table, name) for name in ("fuzzed", "disturbed", "sanitized", "loads")},
    "blocks": run_in_blocks.table,
    **{name: getattr(sizes, f"{name}_table") for name in ("formats", "losses", "sizes", "budgets", "tuned")},
    "recipes": recipes,
    "methods": methods,
    "reproduction": reproduction,
    "settled": settled,
    "outcome": outcome,
    "kit": kit,
    "teeth": teeth,
    "scorecards": scorecards,
    "surfaces": surfaces,
    "power": power,
    "reached": reached,
    "broken": broken_laws,
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
    if "--write" in words:
        for page in PAGES:
            page.write_text(with_tables(page), encoding="utf-8")
        for file, made in LISTS.items():
            file.write_text(made(), encoding="utf-8")
        return 0
    if "--check" not in words:
        print("\n\n".join(make() for make in TABLES.values()))
        return 0
    stale = [page for page in PAGES if with_tables(page) != page.read_text(encoding="utf-8")]
    stale += [file for file, made in LISTS.items() if made() != file.read_text(encoding="utf-8")]
    for page in stale:
        print(f"{page.name}: a table is not what sources and runs say; run 'python docs/tables.py --write'")
    return 1 if stale else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
