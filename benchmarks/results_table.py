"""Tables of what was measured: docs/reliability.md, and the training steps of NOTES.md.

    python benchmarks/results_table.py              print the tables of a training step
    python benchmarks/results_table.py --write      put them into NOTES.md, between their marks
    python benchmarks/results_table.py --check      exit with 1 when NOTES.md holds others

`python docs/tables.py --write` puts the first of a step into docs/speed.md. What `benchmarks.faults` and
`benchmarks.load` have written makes the tables of docs/reliability.md, and `results/cpu.json` those of a training step.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.record import markdown, read_json, with_table

RESULTS = Path(__file__).resolve().parent / "results"
# what came of a disturbed change of the disk, by its key in faults.json
_CAME = {"ended": "ended", "told": "reported", "continued": "continued"}
_KINDS = ("read", "refused", "told", "escaped", "crashed", "hung")
NOTES = Path(__file__).resolve().parent / "NOTES.md"
NOT_YET = "Not measured yet: run `python benchmarks/run.py`."
FEWEST_CORES = 16
BOUNDS = {"operations": "o", "bytes": "b"}
ENGINES = {"fast": "`fast`", "compiled": "`compiled`, autograd", "native": "`compiled`, native"}


def fuzzed() -> str:
    """Make the table of damaged files: what came of them, by reader."""
    whole = read_json(RESULTS / "faults.json")["fuzz"]
    found = whole["readers"]
    total = {kind: sum(row[kind] for row in found.values()) for kind in _KINDS}
    rows = [[name, *_outcomes(row)] for name, row in found.items()] + [["**all**", *_outcomes(total)]]
    head = ["reader", "inputs", "read", "refused in one line", "system", "failures", "crash", "hang"]
    return markdown(head, rows, ["---", *["---:"] * 7]) + _commits(whole, *found.values())


def _commits(*rows: Mapping[str, Any]) -> str:
    """Say in a line below a table which commits its rows are of."""
    found = dict.fromkeys(row["commit"] for row in rows if "commit" in row)
    return f"\n\nCommit{'s' if len(found) > 1 else ''} {', '.join(found)}."


def _outcomes(row: dict[str, int]) -> list[str]:
    # a reader that was tried again alone has its seed and commit there too
    counts = [row[kind] for kind in _KINDS]
    return [f"{count:,}" for count in (sum(counts), *counts)]


def disturbed() -> str:
    """Make the table of runs that were killed or refused their writes, of flipped bits and of sanitizers."""
    found = read_json(RESULTS / "faults.json")
    rows = []
    for kind, kills in found["kills"].items():
        what = f"SIGKILL at random moments of `pop train`, then `--resume`: {kind}"
        tried = f"{kills['kills']:,} kills in {kills['runs']:,} runs"
        rows.append([what, tried, "another result" if kills["failures"] else "the same bits", _failed(kills)])
    for part, what in (("crashes", "the process ends before"), ("writes", "the system refuses")):
        for job, of in found[part].items():
            came = ", ".join(f"{of[key]} {word}" for key, word in _CAME.items() if of.get(key))
            place = f"{what} a write to the disk: {job}"
            rows.append([place, f"{of['tried']} of {of['points']} places", came, _failed(of)])
    for flips in found["flips"].values():
        came = f"{flips['refused']:,} refused, {flips['the same']:,} read as before"
        rows.append(["a flipped bit of a checkpoint", f"{flips['flips']:,}", came, _failed(flips)])
    made = [row for part in ("kills", "crashes", "writes", "flips") for row in found[part].values()]
    return markdown(["event", "tried", "outcome", "failures"], rows, ["---", "---", "---", "---:"]) + _commits(*made)


def sanitized() -> str:
    """Make the table of sanitizers: what was run under which, and of every unit how many of its lines ran."""
    found = read_json(RESULTS / "faults.json")["sanitizers"]
    rows = [
        [name, of["about"], ", ".join(of.get("told", [])) or f"not tried: {of['skipped']}", _failed(of)]
        for name, of in found["checks"].items()
    ]
    rows += [[f"`{unit}`", "", f"{run} of {of} lines ran", ""] for unit, (run, of) in found["lines"].items()]
    return markdown(["code", "sanitizer", "tried", "failures"], rows, ["---", "---", "---", "---:"]) + _commits(found)


def _failed(result: dict[str, Any]) -> str:
    return str(len(result["failures"]))


def loads() -> str:
    """Make the table of large captures and splats: the memory that they took, and the bound that was stated."""
    rows, cases = [], read_json(RESULTS / "load.json")["cases"]
    for name, found in cases.items():
        size = f"{found['width']} x {found['height']}"
        rows.append([name, size, f"{found['peak_gib']:.2f} GiB", f"{found['bound_gib']:.2f} GiB", found["backend"]])
    head = ["load", "photograph or render, px", "peak", "bound", "backend"]
    return markdown(head, rows) + _commits(*cases.values())


def title(case: Mapping[str, Any]) -> str:
    """Say what is trained."""
    real = "" if case["name"][0].isdigit() else f"{case['name']}, bands to {case['degree']}, "
    return f"{real}{case['width']}x{case['height']}, {case['num_gaussians']:,} Gaussians"


def steps(timed: Mapping[str, Any]) -> str:
    """Make the table of times of a step by every engine."""
    head = ["training step of POP", "`fast`", "`compiled`, autograd", "`compiled`, native", "native / autograd"]
    rows = []
    for case in timed["steps"]["cases"]:
        ms, ratios = case["ms"], case["ratios"]
        least = [f"{ms[name]['median']:.0f} ms" for name in ("fast", "compiled")]
        native = f"{ms['native']['median']:.1f} ms ({ms['native']['minimum']:.1f})"
        rows.append([title(case), *least, native, f"{ratios['native / compiled']:.2f}"])
    return f"{markdown(head, rows)}\n\nMedians of turns; of the native step the least turn in brackets."


def native(timed: Mapping[str, Any]) -> str:
    """Make the table of targets, threads and memory of the native step."""
    head = ["case", "target", "native", "one thread", "efficiency of threads", "works in"]
    rows = []
    for case in timed["steps"]["cases"]:
        ms, lone = case["ms"], case["ms"].get("native, 1 thread")
        rows.append(
            [
                title(case),
                "" if case["target_ms"] is None else f"{case['target_ms']:.0f} ms",
                f"{ms['native']['median']:.1f} ms",
                "" if lone is None else f"{lone['median']:.1f} ms",
                "" if lone is None else f"{case['ratios']['efficiency']:.2f}",
                f"{case['working_mib']:.0f} MiB",
            ]
        )
    return markdown(head, rows)


def parts(timed: Mapping[str, Any]) -> str:
    """Make the table of where the native step goes: of each part its time, its floor, what bounds that, their ratio."""
    cases, peak = timed["steps"]["cases"], timed["steps"]["peak"]
    rows = []
    for part in cases[0]["parts"]:
        found = [case["parts"][part] for case in cases]
        rows.append([part, *(_cell(one["ms"], one["floor_ms"], BOUNDS[one["bound"]]) for one in found)])
    sums = [[sum(one[key] for one in case["parts"].values()) for key in ("ms", "floor_ms")] for case in cases]
    rows.append(["all", *(_cell(ms, floor, "") for ms, floor in sums)])
    table = markdown(["part", *map(title, cases)], rows)
    rates = f"{peak['vector_ops_per_s'] / 1e9:.1f} G vector operations/s and {peak['bytes_per_s'] / 1e9:.0f} GB/s"
    legend = "ms (floor ms by operations o or bytes b, ratio)"
    return f"{table}\n\n{legend}; {peak['threads']} threads were seen to do {rates} from memory."


def _cell(ms: float, floor: float, bound: str) -> str:
    return f"{ms:.2f} ({floor:.2f}{bound}, {ms / floor:.1f})"


def counts(timed: Mapping[str, Any]) -> str:
    """Make the table of what a step had to do, and what a pair costs by that."""
    cases = timed["steps"]["cases"]
    lines: list[tuple[str, Callable[[Mapping[str, Any], Mapping[str, int]], str]]] = [
        ("visible", lambda _, did: f"{did['visible']:,}"),
        ("entries of lists, until pixels stop", lambda _, did: f"{did['entries']:,}, {did['walked']:,}"),
        ("pairs a pixel", lambda case, did: f"{did['pairs'] / (case['width'] * case['height']):.1f}"),
        ("of these in strips that are blended, that change", lambda _, did: _shares(did)),
        ("blend, ns a pair", lambda case, did: f"{1e6 * case['parts_ms']['blend'] / did['pairs']:.2f}"),
        ("transpose, ns a pair", lambda case, did: f"{1e6 * case['parts_ms']['transpose'] / did['pairs']:.2f}"),
    ]
    rows = [[what, *(show(case, case["counts"]) for case in cases)] for what, show in lines]
    return markdown(["", *map(title, cases)], rows)


def cores(timed: Mapping[str, Any]) -> str:
    """Make the table of simulated steps on machines of more cores."""
    rows = []
    for case in timed["cores"]:
        one = sum(case["machines"]["1"].values())
        for threads, shares in case["machines"].items():
            # on fewer cores the step was measured
            if int(threads) < FEWEST_CORES:
                continue
            ms = sum(shares.values())
            name = f"{case['width']}x{case['height']}, {case['num_gaussians']:,} Gaussians"
            rows.append([name, threads, f"{ms:.2f}", f"{one / ms:.1f}", *(f"{part:.2f}" for part in shares.values())])
    head = ["case", "cores", "ms", "times one core", *timed["cores"][0]["machines"]["1"]]
    return markdown(head, rows)


def _shares(did: Mapping[str, int]) -> str:
    return ", ".join(f"{16 * did[name] / did['pairs']:.0%}" for name in ("marked", "reached"))


def busy(timed: Mapping[str, Any]) -> str:
    """Make the table of steps among busy processes."""
    rows = []
    for case in timed["busy"]:
        for engine, found in case["engines"].items():
            times = [f"{found[name]:.1f} ms" for name in ("alone_ms", "beside_ms")]
            rows.append([case["name"], ENGINES[engine], *times, f"{found['of_fair_share']:.2f}"])
    first = timed["busy"][0]
    head = ["case", "engine", "alone", f"among {first['processes']} busy processes", "times the fair share"]
    share = f"({first['processes']} + {first['threads']}) / {first['cores']} = {first['fair_factor']:g}"
    return f"{markdown(head, rows)}\n\nThe fair share is {share} times the time alone; means over all steps."


def startup(timed: Mapping[str, Any]) -> str:
    """Make the table of how long commands take until they do something."""
    found = timed["first-step"]
    rows = [[f"`{name}`", f"{one['wall_s']:.2f}", f"{one['cpu_s']:.2f}"] for name, one in found["commands"].items()]
    if "first_step" in found:
        first = found["first_step"]
        command = f"`pop train {first['capture']} --factor {first['factor']} --preset quick`, to its first step"
        rows.append([command, f"{first['wall_s']:.2f}", ""])
    table = markdown(["command", "seconds", "processor seconds"], rows)
    return f"{table}\n\nThe least of {found['repeats']}."


def memory(timed: Mapping[str, Any]) -> str:
    """Make the table of peaks of memory."""
    head = ["what", "by", "before", "at the peak", "of it the step's own"]
    what = {"render": "render and backward", "step": "two training steps"}
    rows = []
    for one in timed["memory"]:
        own = f"{one['working_gib']:.2f} GiB" if "working_gib" in one else ""
        size = f"{what[one['what']]}, {one['width']}x{one['height']}, {one['n']:,} Gaussians"
        rows.append([size, ENGINES[one["by"]], f"{one['before_gib']:.2f} GiB", f"{one['peak_gib']:.2f} GiB", own])
    return markdown(head, rows)


# the part of the results that each table is made of, by its marks in NOTES.md
TABLES: dict[str, tuple[str, Callable[[Mapping[str, Any]], str]]] = {
    "native step": ("steps", native),
    "where a step goes": ("steps", parts),
    "what a step has to do": ("steps", counts),
    "cores": ("cores", cores),
    "busy machine": ("busy", busy),
    "first step": ("first-step", startup),
    "memory": ("memory", memory),
}


def with_tables(text: str, timed: Mapping[str, Any]) -> str:
    """Put every table between its marks."""
    for name, (part, make) in TABLES.items():
        text = with_table(text, name, make(timed) if part in timed else NOT_YET)
    return text


def main(words: list[str]) -> int:
    """Run the script."""
    timed, notes = read_json(RESULTS / "cpu.json"), NOTES.read_text(encoding="utf-8")
    if words == ["--write"]:
        NOTES.write_text(with_tables(notes, timed), encoding="utf-8")
    elif words == ["--check"]:
        if with_tables(notes, timed) != notes:
            print("NOTES.md: a table of the training step is not what was measured; run results_table.py --write")
            return 1
    else:
        made = {name: make(timed) if part in timed else NOT_YET for name, (part, make) in TABLES.items()}
        print("\n\n".join(f"{name}\n\n{table}" for name, table in made.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
