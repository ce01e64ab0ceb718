"""The tables of training results, from the statistics of training runs.

benchmarks/results/training.jsonl has one line a run: what the run wrote into stats/val_step*.json, after its name here.

    python benchmarks/results_table.py --add FILE NAME      add a run's statistics under a name
    python benchmarks/results_table.py                      print the tables
    python benchmarks/results_table.py --check PAGE...      exit with 1 when these pages hold others

`python docs/tables.py --write` puts them into README.md and docs/results.md. Runs of one capture, method and weight of
the POP term that differ in their seed share a row: means, and in brackets the smallest and largest PSNR and SSIM.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from paper_repro.paper import paper
from pop_fast.view.report.source import COLUMNS, markdown, row

RESULTS = Path(__file__).resolve().parent / "results"
RUNS = RESULTS / "training.jsonl"
# of runs under the older reading of growth by blur, which stand in no table
ANY_VIEW = "any_view/"

Stats = dict[str, Any]


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
