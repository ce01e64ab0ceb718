"""Tables of what was measured: training runs, docs/reliability.md, and the training steps of NOTES.md.

benchmarks/results/training.jsonl has one line a run: what the run wrote into stats/val_step*.json, after its name here.

    python benchmarks/results_table.py --add FILE NAME      add a run's statistics under a name
    python benchmarks/results_table.py                      print the tables of runs and of steps
    python benchmarks/results_table.py --write              put those of steps into NOTES.md, between their marks
    python benchmarks/results_table.py --check [PAGE...]    exit with 1 when NOTES.md or these pages hold others

`python docs/tables.py --write` puts those of runs into README.md and docs/results.md, and the first of a step into
README.md. Runs of one capture, method and weight of the POP term that differ in their seed share a row: means, and in
brackets the smallest and largest PSNR and SSIM. What `benchmarks.faults` and `benchmarks.load` have written makes the
tables of docs/reliability.md, and `results/cpu.json` those of a training step.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.record import markdown, read_json, with_table
from paper_repro.paper import paper
from pop_fast.view.report.source import COLUMNS, row
from pop_fast.view.report.source import markdown as table_of_runs

RESULTS = Path(__file__).resolve().parent / "results"
RUNS = RESULTS / "training.jsonl"
# of runs under the older reading of growth by blur, which stand in no table
ANY_VIEW = "any_view/"
Stats = dict[str, Any]
# what came of a disturbed change of the disk, by its key in faults.json
_CAME = {"ended": "ended", "told": "reported", "continued": "continued"}
_KINDS = ("read", "refused", "told", "escaped", "crashed", "hung")
NOTES = Path(__file__).resolve().parent / "NOTES.md"
NOT_YET = "Not measured yet: run `python benchmarks/run.py`."
FEWEST_CORES = 16
BOUNDS = {"operations": "o", "bytes": "b"}
ENGINES = {"fast": "`fast`", "compiled": "`compiled`, autograd", "native": "`compiled`, native"}


def table(runs: Path = RUNS) -> str:
    """Make the table of all runs, by capture, POP before others."""
    return table_of_runs([_row(runs) for runs in _groups(runs)])


def summary(runs: Path = RUNS) -> str:
    """Make the short table: POP at the paper's weight of its term, and the two baselines, a capture a line."""
    chosen = _by_capture(runs)
    rows = [[capture, *(_short(of.get(name)) for name in ("pop", "gsplat", "3dgs"))] for capture, of in chosen.items()]
    return markdown(["capture", "POP", "gsplat's default strategy", "3DGS"], rows)


def _by_capture(runs: Path) -> dict[str, dict[str, Stats]]:
    """Return means over seeds by capture and method."""
    chosen: dict[str, dict[str, Stats]] = {}
    for stats in map(_mean, _groups(runs)):
        # of several weights of the POP term the smallest, which is the paper's
        chosen.setdefault(stats["capture"], {}).setdefault(stats["method"], stats)
    return chosen


def _short(stats: Stats | None) -> str:
    return "not run" if stats is None else f"{stats['psnr']:.2f} dB, {stats['num_GS']:,}"


def differences() -> str:
    """Make the table of what POP is less gsplat's strategy: of these runs, and of the paper's main tables."""
    rows = []
    for capture, of in sorted(_by_capture(RUNS).items()):
        if "pop" in of and "gsplat" in of:
            steps = f"{of['pop']['step'] + 1:,} steps, measured here"
            rows.append([capture, steps, *_differences(of["pop"], of["gsplat"], "num_GS")])
    published = paper()
    for dataset, number in (("Mip-NeRF 360", 1), ("Tanks & Temples", 2), ("Deep Blending", 1)):
        ours, base = (published.table(number).row(row).values[dataset] for row in ("pop", "gsplat"))
        rows.append([dataset, "30,000 steps, the paper's", *_differences(ours, base, "num_gaussians_k")])
    head = ["scene", "schedule", "PSNR", "SSIM", "Gaussians"]
    return markdown(head, rows, ["---", "---", "---:", "---:", "---:"])


def _differences(ours: Mapping[str, Any], base: Mapping[str, Any], count: str) -> list[str]:
    psnr, ssim = (ours[name] - base[name] for name in ("psnr", "ssim"))
    return [f"{psnr:+.2f} dB", f"{ssim:+.3f}", f"{ours[count] / base[count]:.1%}"]


def _groups(path: Path) -> list[list[Stats]]:
    runs = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    groups: dict[tuple[Any, ...], list[Stats]] = {}
    for stats in runs:
        if stats["run"].startswith(ANY_VIEW):
            continue
        key = (stats["capture"], stats["method"] != "pop", stats["method"], stats.get("lambda_pop", 0.0))
        groups.setdefault(key, []).append(stats)
    return [groups[key] for key in sorted(groups)]


def _mean(runs: Sequence[Stats]) -> Stats:
    """Return the first run's statistics with the means of what is a number in all of them."""
    merged = dict(runs[0])
    for name, value in merged.items():
        if isinstance(value, (int, float)) and name != "step":
            mean = sum(stats[name] for stats in runs) / len(runs)
            merged[name] = round(mean) if isinstance(value, int) else mean
    return merged


def _row(runs: Sequence[Stats]) -> list[str]:
    cells = row(_mean(runs))
    if len(runs) == 1:
        return cells
    cells[0] += f", {len(runs)} seeds"
    for name, key, form in (("PSNR", "psnr", ".2f"), ("SSIM", "ssim", ".4f")):
        values = [stats[key] for stats in runs]
        cells[COLUMNS.index(name)] += f" ({min(values):{form}} to {max(values):{form}})"
    return cells


def add(statistics: Path, name: str, runs: Path = RUNS) -> None:
    """Add a run's statistics; a run of the same name is replaced."""
    kept = [json.loads(line) for line in runs.read_text(encoding="utf-8").splitlines()]
    kept = [stats for stats in kept if stats["run"] != name]
    kept.append({"run": name, **json.loads(statistics.read_text(encoding="utf-8"))})
    kept.sort(key=lambda stats: (stats["run"].startswith(ANY_VIEW), stats["run"]))
    runs.write_text("".join(json.dumps(stats, separators=(",", ":")) + "\n" for stats in kept), encoding="utf-8")


def fuzzed() -> str:
    """Make the table of damaged files: what came of them, by reader."""
    found = read_json(RESULTS / "faults.json")["fuzz"]["readers"]
    total = {kind: sum(row[kind] for row in found.values()) for kind in _KINDS}
    rows = [[name, *_outcomes(row)] for name, row in found.items()] + [["**all**", *_outcomes(total)]]
    head = ["reader", "inputs", "read", "refused in one line", "system", "failures", "crash", "hang"]
    return markdown(head, rows, ["---", *["---:"] * 7])


def _outcomes(row: dict[str, int]) -> list[str]:
    # a reader that was tried again alone has its seed there too
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
    return markdown(["event", "tried", "outcome", "failures"], rows, ["---", "---", "---", "---:"])


def sanitized() -> str:
    """Make the table of sanitizers: what was run under which, and of every unit how many of its lines ran."""
    found = read_json(RESULTS / "faults.json")["sanitizers"]
    rows = [
        [name, of["about"], ", ".join(of.get("told", [])) or f"not tried: {of['skipped']}", _failed(of)]
        for name, of in found["checks"].items()
    ]
    rows += [[f"`{unit}`", "", f"{run} of {of} lines ran", ""] for unit, (run, of) in found["lines"].items()]
    return markdown(["code", "sanitizer", "tried", "failures"], rows, ["---", "---", "---", "---:"])


def _failed(result: dict[str, Any]) -> str:
    return str(len(result["failures"]))


def loads() -> str:
    """Make the table of large captures and splats: the memory that they took, and the bound that was stated."""
    rows = []
    for name, found in read_json(RESULTS / "load.json")["cases"].items():
        size = f"{found['width']} x {found['height']}"
        rows.append([name, size, f"{found['peak_gib']:.2f} GiB", f"{found['bound_gib']:.2f} GiB", found["backend"]])
    return markdown(["load", "photograph or render, px", "peak", "bound", "backend"], rows)


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
    if words[:1] == ["--add"]:
        add(Path(words[1]), words[2])
        return 0
    tables, timed, notes = (
        (table(), differences(), summary()),
        read_json(RESULTS / "cpu.json"),
        NOTES.read_text(encoding="utf-8"),
    )
    if words == ["--write"]:
        NOTES.write_text(with_tables(notes, timed), encoding="utf-8")
        return 0
    if words[:1] != ["--check"]:
        of_steps = (make(timed) if part in timed else NOT_YET for part, make in TABLES.values())
        print("\n\n".join((*tables, *(f"{name}\n\n{made}" for name, made in zip(TABLES, of_steps, strict=True)))))
        return 0
    text = "\n".join(Path(word).read_text(encoding="utf-8") for word in words[1:])
    if words[1:] and any(f"\n{made}\n" not in text for made in tables):
        print(f"{' '.join(words[1:])}: a results table is not what the runs say; run 'python docs/tables.py --write'")
        return 1
    if with_tables(notes, timed) != notes:
        print("NOTES.md: a table of the training step is not what was measured; run results_table.py --write")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
