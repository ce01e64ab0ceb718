"""Put every mutant on trial: `python -m pop_ref.conformance.mutants [--every]`."""

from __future__ import annotations

import argparse

from pop_ref.conformance.mutants import MUTANTS
from pop_ref.conformance.mutants.trial import killed_by, killers


def report(every: bool) -> str:
    """Return a line a mutant: how its law breaks on it; with `every`, all laws that do."""
    lines = []
    for mutant in MUTANTS:
        breaks = killed_by(mutant)
        lines.append(f"{mutant.name}: {'SURVIVES' if breaks is None else 'killed by'} {mutant.law} ({breaks})")
        if every:
            lines += [f"    {path}" for path in killers(mutant)]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="put every mutant on trial")
    parser.add_argument("--every", action="store_true", help="try every law on every mutant and list those that break")
    print(report(parser.parse_args().every))
