"""The tables of training results, from the statistics of training runs, and those of docs/reliability.md.

benchmarks/results/training.jsonl has one line a run: what the run wrote into stats/val_step*.json, after its name here.

    python benchmarks/results_table.py --add FILE NAME      add a run's statistics under a name
    python benchmarks/results_table.py                      print the tables
    python benchmarks/results_table.py --check PAGE...      exit with 1 when these pages hold others

`python docs/tables.py --write` puts them into README.md and docs/results.md. Runs of one capture, method and weight of
the POP term that differ in their seed share a row: means, and in brackets the smallest and largest PSNR and SSIM.
What `benchmarks.faults` and `benchmarks.load` have written makes the tables of docs/reliability.md.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from paper_repro.paper import paper
from pop_fast.view.report.source import COLUMNS, markdown, row

RESULTS = Path(__file__).resolve().parent / "results"
RUNS = RESULTS / "training.jsonl"
# of runs under the older reading of growth by blur, which stand in no table
ANY_VIEW = "any_view/"
Stats = dict[str, Any]
_KINDS = ("read", "refused", "told", "escaped", "crashed", "hung")


def table(runs: Path = RUNS) -> str:
    """Make the table of all runs, by capture, POP before others."""
    return markdown([_row(runs) for runs in _groups(runs)])


def summary(runs: Path = RUNS) -> str:
    """Make the short table: POP at the paper's weight of its term, and the two baselines, a capture a line."""
    chosen: dict[str, dict[str, Stats]] = {}
    for stats in map(_mean, _groups(runs)):
        # of several weights of the POP term the smallest, which is the paper's
        chosen.setdefault(stats["capture"], {}).setdefault(stats["method"], stats)
    lines = ["| capture | POP | gsplat's default strategy | 3DGS |", "| --- | --- | --- | --- |"]
    for capture, methods in chosen.items():
        cells = [_short(methods.get(name)) for name in ("pop", "gsplat", "3dgs")]
        lines.append(f"| {capture} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _short(stats: Stats | None) -> str:
    return "not run" if stats is None else f"{stats['psnr']:.2f} dB, {stats['num_GS']:,}"


def differences(runs: Path = RUNS) -> str:
    """Make the table of what POP is less gsplat's strategy: of these runs, and of the paper's main tables."""
    lines = ["| scene | schedule | PSNR | SSIM | Gaussians |", "| --- | --- | ---: | ---: | ---: |"]
    means: dict[tuple[str, str], Stats] = {}
    for stats in map(_mean, _groups(runs)):
        # of several weights of the POP term the smallest, which is the paper's
        means.setdefault((stats["capture"], stats["method"]), stats)
    for capture in sorted({capture for capture, _ in means}):
        pop, control = means.get((capture, "pop")), means.get((capture, "gsplat"))
        if pop and control:
            share = pop["num_GS"] / control["num_GS"]
            steps = f"{pop['step'] + 1:,} steps, measured here"
            lines.append(
                _difference(capture, steps, pop["psnr"] - control["psnr"], pop["ssim"] - control["ssim"], share)
            )
    published = paper()
    for dataset, number in (("Mip-NeRF 360", 1), ("Tanks & Temples", 2), ("Deep Blending", 1)):
        ours, base = (published.table(number).row(row).values[dataset] for row in ("pop", "gsplat"))
        share = ours["num_gaussians_k"] / base["num_gaussians_k"]
        found = (ours["psnr"] - base["psnr"], ours["ssim"] - base["ssim"], share)
        lines.append(_difference(dataset, "30,000 steps, the paper's", *found))
    return "\n".join(lines)


def _difference(scene: str, schedule: str, psnr: float, ssim: float, share: float) -> str:
    return f"| {scene} | {schedule} | {psnr:+.2f} dB | {ssim:+.3f} | {share:.1%} |"


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


def main(words: list[str]) -> int:
    """Run the script."""
    if words[:1] == ["--add"]:
        add(Path(words[1]), words[2])
        return 0
    tables = (table(), differences(), summary())
    if words[:1] != ["--check"]:
        print("\n\n".join(tables))
        return 0
    text = "\n".join(Path(word).read_text(encoding="utf-8") for word in words[1:])
    if any(f"\n{made}\n" not in text for made in tables):
        print(f"{' '.join(words[1:])}: a results table is not what the runs say; run 'python docs/tables.py --write'")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
