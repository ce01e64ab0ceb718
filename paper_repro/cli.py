"""The command line of the reproduction, `pop-repro`: arguments and printing only.

What trains, draws or reads results is imported when its command is called, so that help and typing errors are quick.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from paper_repro.jobs import SEED, WORK
from paper_repro.results import RESULTS
from paper_repro.scales import SCALES
from pop_fast.errors import PopError

EXIT_INCOMPLETE: Final = 1
EXIT_BAD_INPUT: Final = 2
# another process trains the row
EXIT_BUSY: Final = 75
EXIT_INTERRUPTED: Final = 130

_EXAMPLES: Final = """
examples:
  pop-repro run pop demo --scale toy                    one row in seconds, without data
  pop-repro run pop fox --scale dev --data DATA         one row on a CPU; the same command goes on after a stop
  pop-repro queue --scale dev --data DATA --nice 10     every row that is missing, the cheapest first
  pop-repro data check --data DATA                      what of the paper's scenes is there, and where to get the rest
  pop-repro status --scale dev                          which rows are done
  pop-repro table 1 --scale dev                         the paper's first table from them

'pop-repro COMMAND --help' explains one. --debug (or POP_DEBUG=1) shows the traceback of an error.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and turn what went wrong into one line and an exit status.

    Args:
        argv: the words after `pop-repro`; the process's own when None.

    Returns:
        0, or 1 where something is missing or failed, or 2 for bad input and bad usage, or 75 where another process
        trains the row, or 130 after Ctrl-C or SIGTERM.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words or os.environ.get("POP_DEBUG", "") not in ("", "0")
    try:
        args = _parser().parse_args([word for word in words if word != "--debug"])
        call: Callable[[argparse.Namespace], int] = args.call
        status = call(args)
        sys.stdout.flush()
        return status
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0
    except KeyboardInterrupt:
        print("pop-repro: stopped; the same command goes on from the last checkpoint", file=sys.stderr)
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        # the reader has gone, as in `pop-repro status | head`: what is still buffered has nowhere to go
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        from pop_fast.cli.errors import describe

        line = str(error) if isinstance(error, PopError) else describe(error)
        if debug or line is None:
            raise
        print(f"pop-repro: error: {line}", file=sys.stderr)
        return EXIT_BUSY if type(error).__name__ == "Busy" else EXIT_BAD_INPUT


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="pop-repro",
        description="Every method, table and figure of the paper, from nothing or from the results that are there.",
        epilog=_EXAMPLES,
        formatter_class=raw,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_run(commands)
    return parser


def _add_run(commands: argparse._SubParsersAction) -> None:
    parser = commands.add_parser(
        "run",
        help="train one row on one scene, or go on with it",
        description="Train one row on one scene, or go on with it, and write its result as one JSON file.",
        allow_abbrev=False,
    )
    parser.add_argument("row", metavar="ROW", help="a file of configs: pop, gsplat, 3dgs, l2_blur, ...")
    parser.add_argument("scene", metavar="SCENE", help="fox, bonsai_800, garden, ...; the scale says which")
    parser.add_argument("--seed", type=int, default=SEED, help="of every random number (default: %(default)s)")
    _add_training(parser)
    parser.set_defaults(call=_run)


def _add_training(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scale", choices=SCALES, default="dev", help="how much of the protocol (default: %(default)s)")
    data = os.environ.get("POP_DATA", "data")
    parser.add_argument("--data", type=Path, default=Path(data), metavar="DIR", help="folder of the scenes (%(default)s)")
    parser.add_argument("--out", type=Path, default=RESULTS, metavar="DIR", help="folder of results")
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR", help="folder of checkpoints, can be removed")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads, 0 for all cores (default: %(default)s)")
    engines = ("auto", "fast", "compiled", "cuda", "ref")
    parser.add_argument("--backend", choices=engines, default="auto", help="as pop train (default: %(default)s)")
    parser.add_argument("--checkpoint-every", type=int, metavar="STEPS", help="steps that a kill can cost")
    parser.add_argument("--log-every", type=int, metavar="STEPS", help="steps between two points of the curve")
    for net in ("vgg", "alex"):
        parser.add_argument(f"--lpips-{net}", nargs="+", default=[], metavar="FILE", help=f"LPIPS weights on {net}")
    parser.add_argument("--keep-ply", action="store_true", help="keep the Gaussians in the work folder")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep the checkpoints too")


def _run(args: argparse.Namespace) -> int:
    from paper_repro.jobs import job_named
    from paper_repro.train_row import Options, train_row

    job = job_named(args.row, args.scene, args.scale, args.seed)
    options = Options(
        data=args.data,
        results=args.out,
        work=args.work,
        threads=args.threads,
        backend=args.backend,
        checkpoint_every=args.checkpoint_every,
        log_every=args.log_every,
        lpips_vgg=tuple(args.lpips_vgg),
        lpips_alex=tuple(args.lpips_alex),
        keep_ply=args.keep_ply,
        keep_checkpoints=args.keep_checkpoints,
    )
    print(train_row(job, options))
    return 0
