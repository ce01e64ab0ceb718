"""Put every mutant on trial: `python -m pop_ref.conformance.mutants [--every] [NAME ...]`."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

from pop_ref.conformance.hypothesis_profiles import EXAMPLES
from pop_ref.conformance.mutants import BLACK_BOXES, MUTANTS, PROGRAM, BlackBox, Mutant
from pop_ref.conformance.mutants.trial import killed_by, killers

# the kinds that are counted apart: what the kit has to see from outside says nothing of what stages show
KINDS = {"of the oracle": MUTANTS, "of the program that trains": PROGRAM, "behind gsplat's signature": BLACK_BOXES}


def report(mutants: Sequence[Mutant | BlackBox], every: bool, examples: int) -> Iterator[str]:
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
    everyone = tuple(mutant for kind in KINDS.values() for mutant in kind)
    unknown = set(args.names) - {mutant.name for mutant in everyone}
    if unknown:
        parser.error(f"there is no mutant {', '.join(sorted(unknown))}")
    chosen = [mutant for mutant in everyone if not args.names or mutant.name in args.names]
    alive: set[str] = set()
    for line in report(chosen, args.every, args.examples):
        name, survives, _ = line.partition(": SURVIVES ")
        alive |= {name} if survives else set()
        print(line, flush=True)
    for kind, mutants in KINDS.items():
        tried = [mutant.name for mutant in mutants if mutant in chosen]
        if tried:
            print(f"{kind}: {len(set(tried) - alive)} of {len(tried)} killed")
    return 1 if alive else 0


if __name__ == "__main__":
    raise SystemExit(main())
