"""Put every mutant on trial: `python -m pop_ref.conformance.mutants [--every] [NAME ...]`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from pop_ref.conformance.examples import EXAMPLES
from pop_ref.conformance.mutants import MUTANTS, PROGRAM, Mutant
from pop_ref.conformance.mutants.trial import killed_by, killers


def report(mutants: Sequence[Mutant], every: bool, examples: int) -> Iterator[str]:
    """Yield a line a mutant: how its law breaks on it; with `every`, all laws that do, and how many they are."""
    for mutant in mutants:
        breaks = killed_by(mutant)
        yield f"{mutant.name}: {'SURVIVES' if breaks is None else 'killed by'} {mutant.law} ({breaks})"
        if every:
            found = killers(mutant, examples)
            yield f"    {len(found)} laws notice with {examples} examples each: {', '.join(found)}"


def main(words: Sequence[str] | None = None) -> int:
    """Run the trial; the status is 1 when a mutant survives."""
    parser = argparse.ArgumentParser(description="put every mutant on trial")
    parser.add_argument("names", nargs="*", metavar="NAME", help="only these mutants")
    parser.add_argument("--every", action="store_true", help="try every law on every mutant and list those that break")
    parser.add_argument("--examples", type=int, default=EXAMPLES["ci"], help="of each law under --every")
    args = parser.parse_args(words)
    everyone = (*MUTANTS, *PROGRAM)
    unknown = set(args.names) - {mutant.name for mutant in everyone}
    if unknown:
        parser.error(f"there is no mutant {', '.join(sorted(unknown))}")
    chosen = [mutant for mutant in everyone if not args.names or mutant.name in args.names]
    survived = False
    for line in report(chosen, args.every, args.examples):
        survived |= ": SURVIVES " in line
        print(line, flush=True)
    return 1 if survived else 0


if __name__ == "__main__":
    raise SystemExit(main())
