"""Print which law kills which mutant, as a Markdown table: `python -m pop_ref.conformance.mutants`."""

from __future__ import annotations

import argparse

from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.trial import killed_by, killers


def table(every: bool) -> str:
    """Return the table; with `every`, all laws are tried on each mutant and counted."""
    lines = ["| mutant | what happened | broken in | killed by |", "| --- | --- | --- | --- |"]
    for mutant in MUTANTS:
        verdict = mutant.law.partition(":")[2].replace("_", " ")
        if every:
            verdict += f" ({len(killers(mutant))} laws in all)"
        elif killed_by(mutant) is None:
            verdict = "**survives**"
        lines.append(f"| {mutant.name.replace('_', ' ')} | {mutant.story} | `{mutant.file}` | {verdict} |")
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="which law kills which mutant")
    parser.add_argument("--every", action="store_true", help="try every law on every mutant and count those that break")
    print(table(parser.parse_args().every))
