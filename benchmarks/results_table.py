"""The results table of README.md, from the statistics of training runs.

Copy stats/val_step*.json of a finished run to benchmarks/results/training/<capture>_<method>.json; then

    python benchmarks/results_table.py            print the table
    python benchmarks/results_table.py --write    put it into README.md
    python benchmarks/results_table.py --check    exit with 1 when README.md holds another one
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pop_fast.report.compare import markdown, row

ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "benchmarks" / "results" / "training"
BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"


def table(folder: Path = RUNS) -> str:
    """Make the table of all runs in a folder, by capture, POP before others."""
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    runs.sort(key=lambda stats: (stats["capture"], stats["method"] != "pop", stats["method"]))
    return markdown([row(stats) for stats in runs])


def with_table(readme: str, folder: Path = RUNS) -> str:
    """Put the table between its marks in README.md's text."""
    before, rest = readme.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}\n{table(folder)}\n{END}{after}"


def main(words: list[str]) -> int:
    """Run the script."""
    path = ROOT / "README.md"
    if "--write" not in words and "--check" not in words:
        print(table())
        return 0
    readme = path.read_text(encoding="utf-8")
    if "--write" in words:
        path.write_text(with_table(readme), encoding="utf-8")
    elif with_table(readme) != readme:
        print("README.md: the results table is not what the runs say; run 'python benchmarks/results_table.py --write'")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
