"""`pop-repro verify`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from paper_repro.cli import EXIT_INCOMPLETE, parser_of
from paper_repro.cli.options import WORK, add_backend, add_data, add_results, add_scale

__all__ = ["verify"]

_SEED: Final = 42
_SHOWN: Final = 5  # differences
_VERIFY: Final = """
    pop-repro verify pop fox --data DATA                  all steps; the same command continues after a stop
    pop-repro verify pop fox --data DATA --steps 500      the first 500, in a minute or so
"""


def verify(words: Sequence[str]) -> int:
    """Train a finished row again and print whether its result comes out."""
    parser = parser_of("verify", _VERIFY)
    parser.add_argument("row", metavar="ROW", help="a row with a result")
    parser.add_argument("scene", metavar="SCENE", help="one of the scale's: fox, bonsai_800, garden, ...")
    parser.add_argument("--seed", type=int, default=_SEED, help="of the result (default: %(default)s)")
    parser.add_argument("--steps", type=_positive, metavar="N", help="the first steps alone (default: all)")
    add_scale(parser)
    add_data(parser)
    add_results(parser)
    note = "the folder that the commit is cloned and trained in (default: %(default)s)"
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR", help=note)
    add_backend(parser, "what takes the steps (default: what took those of the result)")
    args = parser.parse_args(words)
    from paper_repro.jobs import job_named
    from paper_repro.results import existing_folder
    from paper_repro.train_row import Options
    from paper_repro.verify import TOLERANCES
    from paper_repro.verify import verify as verified

    job = job_named(args.row, args.scene, args.scale, args.seed)
    options = Options(data=args.data, results=existing_folder(args.results), work=args.work, backend=args.backend)
    made = verified(job, options, args.steps)
    told = f"{made.points} points of the curve{', the held-out views and the Gaussians' if made.finished else ''}"
    if made.kind:
        print(f"another kind of machine: {'; '.join(made.kind)}")
        told += f" within {', '.join(f'{value:g} of {name}' for name, value in TOLERANCES.items())}"
    print(f"{job}: {made.steps:,} steps were trained again; compared {told}")
    if not made.differences:
        print("confirmed" if made.kind else "confirmed: all of it is equal")
        return 0
    print(f"NOT confirmed: {len(made.differences)} values differ")
    print("\n".join(f"  {difference}" for difference in made.differences[:_SHOWN]))
    return EXIT_INCOMPLETE


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"is '{text}'; it must be a whole number of at least 1")
    return int(text)
