"""`pop-repro run` and `pop-repro queue`."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

from paper_repro.cli import EXIT_INCOMPLETE, EXIT_INTERRUPTED, parser_of
from paper_repro.cli.options import add_training, training_words

if TYPE_CHECKING:
    from paper_repro.jobs import Job

__all__ = ["queue", "run"]

_SEED: Final = 42
_RUN: Final = """
    pop-repro run pop demo --scale toy                    in seconds, on a capture that the program makes
    pop-repro run pop fox --scale small --data DATA         the same command continues after a stop
    pop-repro run l2_blur bonsai_800 --scale full --data DATA --threads 2
"""
_QUEUE: Final = """
    pop-repro queue --scale toy                           every row in minutes
    pop-repro queue --scale small --data DATA --nice 10     days; Ctrl-C or SIGTERM stops it, the same command continues
    pop-repro queue --scale small --data DATA --rows pop gsplat 3dgs --scenes fox bear_512 --seeds 3
    pop-repro queue --scale small --data DATA --list        what is missing, in order, without training
    pop-repro queue --scale paper --data DATA --check     the hours of each row, and what is lacking here
"""


def run(words: Sequence[str]) -> int:
    """Train one row and print the file that has its result."""
    parser = parser_of("run", _RUN)
    parser.add_argument("row", metavar="ROW", help="a file of configs: pop, gsplat, 3dgs, l2_blur, ...")
    parser.add_argument("scene", metavar="SCENE", help="one of the scale's: fox, bonsai_800, garden, ...")
    parser.add_argument("--seed", type=int, default=_SEED, help="of every random number (default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="train a finished row again, and replace its result")
    add_training(parser)
    args = parser.parse_args(words)
    from paper_repro.jobs import job_named
    from paper_repro.train_row import Options, finished, train_row

    job = job_named(args.row, args.scene, args.scale, args.seed)
    before = None if args.again else finished(job, args.results)
    if before is None:
        train_row(job, Options(again=args.again, **_options(args)))
    else:
        at = "" if before.commit is None else f" at commit {before.commit[:7]}"
        print(
            f"{job} is finished: {before.psnr:.2f} dB with {before.num_gaussians:,} Gaussians, trained{at}; "
            "--again trains it again"
        )
    print(job.file(args.results))
    return 0


def queue(words: Sequence[str]) -> int:
    """Train the rows that are missing."""
    parser = parser_of("queue", _QUEUE)
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="these rows alone (default: all)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="these scenes alone (default: the scale's)")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help=f"seeds of each: {_SEED}, {_SEED + 1}, ...")
    parser.add_argument("--nice", type=int, default=0, metavar="N", help="give way to other programs, 0 to 19")
    parser.add_argument("--commit", action="store_true", help="commit each result in git when it is there")
    parser.add_argument("--list", action="store_true", help="list what is missing, in order, and train nothing")
    note = "say the hours and what of data, disk, memory and GPU is lacking, and train nothing; scale paper begins so"
    parser.add_argument("--check", action="store_true", help=note)
    add_training(parser)
    args = parser.parse_args(words)
    from paper_repro.jobs import jobs_of
    from paper_repro.queue import run_queue
    from paper_repro.rows import ROWS

    seeds = range(_SEED, _SEED + args.seeds)
    jobs = jobs_of(args.scale, args.rows or ROWS, args.scenes, seeds)
    if args.list:
        print("\n".join(str(job) for job in jobs if not job.is_done(args.results)))
        return 0
    if args.check or args.scale == "paper":
        ready = _ready([job for job in jobs if not job.is_done(args.results)], args)
        if args.check or not ready:
            return 0 if ready else EXIT_INCOMPLETE
    if args.nice:
        os.nice(args.nice)
    outcome = run_queue(jobs, args.results, training_words(args), args.threads, args.commit)
    left = {"failed": outcome.failed, "not in this version": outcome.impossible, "trained elsewhere": outcome.busy}
    print(f"{len(outcome.done)} rows trained")
    for what, some in left.items():
        if some:
            print(f"{what}: {', '.join(f'{job.row.name} {job.scene.name} {job.seed}' for job in some)}")
    if outcome.stopped:
        print("stopped; the same command continues")
        return EXIT_INTERRUPTED
    return EXIT_INCOMPLETE if any(left.values()) else 0


def _ready(missing: Sequence[Job], args: argparse.Namespace) -> bool:
    """Print what the missing rows take and what is lacking for them; tell whether nothing is."""
    from paper_repro.preflight import hours_by_row, lacking

    print("\n".join([f"{len(missing)} trainings to go", *hours_by_row(missing)]), flush=True)
    found = lacking(missing, args.data, args.work, args.backend)
    print("\n".join(["lacking:", *(f"  {line}" for line in found)] if found else ["nothing is lacking"]), flush=True)
    return not found


def _options(args: argparse.Namespace) -> dict[str, Any]:
    names = (
        *("data", "results", "work", "published", "threads", "backend", "checkpoint_every", "log_every"),
        *("keep_ply", "keep_checkpoints", "untimed"),
    )
    return {
        **{name: getattr(args, name) for name in names},
        **{name: tuple(getattr(args, name)) for name in ("lpips_vgg", "lpips_alex")},
    }
