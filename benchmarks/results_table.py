"""The results table of README.md, from the statistics of training runs.

Copy stats/val_step*.json of a finished run to benchmarks/results/training/<capture>_<method>.json; then

    python benchmarks/results_table.py                      print the table
    python benchmarks/results_table.py --check README.md    exit with 1 when that file holds another one

`python docs/tables.py --write` puts it into README.md.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pop_fast.report.compare import markdown, row

RUNS = Path(__file__).resolve().parent / "results" / "training"


def table(folder: Path = RUNS) -> str:
    """Make the table of all runs in a folder, by capture, POP before others."""
    runs = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    runs.sort(key=lambda stats: (stats["capture"], stats["method"] != "pop", stats["method"]))
    return markdown([row(stats) for stats in runs])


def main(words: list[str]) -> int:
    """Run the script."""
    if words[:1] != ["--check"]:
        print(table())
        return 0
    if f"\n{table()}\n" not in Path(words[1]).read_text(encoding="utf-8"):
        print(f"{words[1]}: the results table is not what the runs say; run 'python docs/tables.py --write'")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
