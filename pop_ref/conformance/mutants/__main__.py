"""Put every mutant on trial: `python -m pop_ref.conformance.mutants [--every] [--json FILE] [NAME ...]`.

A mutant is tried in each precision that it has. With `--json`, how its law breaks is kept by family, mutant and
precision, None where the mutant survives; where mutants are named, those of them alone are kept anew.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from pop_ref.conformance.files import write_file
from pop_ref.conformance.hypothesis_profiles import EXAMPLES
from pop_ref.conformance.mutants import FAMILIES, BlackBox, Mutant
from pop_ref.conformance.mutants.trial import killed_by, killers

Trials = dict[str, dict[str, dict[str, str | None]]]


def tried(chosen: Sequence[str]) -> Iterator[tuple[str, Mutant | BlackBox, str, str | None]]:
    """Yield family, mutant, precision and how the mutant's law breaks, None where the mutant survives.

    Args:
        chosen: names of mutants; none for all.
    """
    for family, mutants in FAMILIES.items():
        for mutant in mutants:
            if not chosen or mutant.name in chosen:
                for dtype in mutant.precisions:
                    yield family, mutant, dtype, killed_by(mutant, dtype)


def report(chosen: Sequence[str], every: bool, examples: int) -> Trials:
    """Print a line for each mutant and precision; with `every`, all laws that notice it, too; return what was found."""
    found: Trials = {}
    for family, mutant, dtype, breaks in tried(chosen):
        found.setdefault(family, {}).setdefault(mutant.name, {})[dtype] = breaks and breaks[:120]
        verdict = "SURVIVES" if breaks is None else "killed by"
        print(f"{mutant.name} in {dtype}: {verdict} {mutant.law} ({breaks})", flush=True)
        if every and dtype == mutant.precisions[-1]:
            laws = killers(mutant, examples)
            print(f"    {len(laws)} laws notice with {examples} examples each: {', '.join(laws)}", flush=True)
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Run the trial; the status is 1 when a mutant survives."""
    parser = argparse.ArgumentParser(description="put every mutant on trial")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these mutants")
    parser.add_argument("--every", action="store_true", help="try every law on every mutant and list those that break")
    parser.add_argument("--examples", type=int, default=EXAMPLES["ci"], help="of each law under --every")
    parser.add_argument("--json", type=Path, metavar="FILE", help="keep how each mutant dies")
    args = parser.parse_args(words)
    unknown = set(args.names) - {mutant.name for mutants in FAMILIES.values() for mutant in mutants}
    if unknown:
        parser.error(f"there is no mutant {', '.join(sorted(unknown))}")
    found = report(args.names, args.every, args.examples)
    if args.json:
        kept: Trials = json.loads(args.json.read_text(encoding="utf-8")) if args.names and args.json.is_file() else {}
        # in the order of the families, without what is no longer there
        trials = {
            family: {
                m.name: now for m in mutants if (now := (kept.get(family, {}) | found.get(family, {})).get(m.name))
            }
            for family, mutants in FAMILIES.items()
        }
        write_file(args.json, json.dumps(trials, indent=1) + "\n")
    alive = 0
    for family, of in found.items():
        killed = sum(None not in breaks.values() for breaks in of.values())
        alive += len(of) - killed
        print(f"{family}: {killed} of {len(of)} killed")
    return 1 if alive else 0


if __name__ == "__main__":
    raise SystemExit(main())
