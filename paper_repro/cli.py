"""The command line of the reproduction, `pop-repro`: arguments and printing only.

What trains, draws or computes is imported when its command is called, so that help and typing errors are quick.
"""

from __future__ import annotations

import argparse
import difflib
import os
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Final

from paper_repro.jobs import ROWS, SEED, WORK, Job, job_named, jobs_of
from paper_repro.results import RESULTS, existing_folder, read_all
from paper_repro.scenes import MADE, SCALES, SCENES, find_folder, scale_named, scene_named
from pop_fast.api.backend import backend_names
from pop_fast.cli import EXIT_BAD_INPUT, EXIT_INCOMPLETE, EXIT_INTERRUPTED, guarded
from pop_fast.errors import PopError

_TEXT: Final = """\
usage: pop-repro COMMAND ...

Every method, table and figure of the paper, from scratch or from existing results.

commands:
{commands}

start here:
  pop-repro run pop demo --scale toy                    one row in seconds, without data
  pop-repro data check --data DATA                      which of the paper's scenes are present
  pop-repro queue --scale small --data DATA --nice 10     days of training, stopped and resumed at any time
  pop-repro table 1 --scale small                         the paper's first table from the results
  snakemake -s {snakefile} -n        the same as a workflow, for a cluster or a cloud

'pop-repro COMMAND --help' explains one. --debug (or POP_DEBUG=1) shows the traceback of an error."""


def _parser_of(command: str, examples: str = "") -> argparse.ArgumentParser:
    """Make the parser of a subcommand.

    Args:
        command: its name.
        examples: shown under the options, one a line.
    """
    about = COMMANDS[command][1]
    return argparse.ArgumentParser(
        prog=f"pop-repro {command}",
        description=about[0].upper() + about[1:] + ".",
        epilog="examples:\n" + "\n".join(f"  {line.strip()}" for line in examples.strip().splitlines()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )


def _add_scale(parser: argparse.ArgumentParser) -> None:
    about = "; ".join(f"{scale.name}: {scale.about}" for scale in SCALES.values())
    parser.add_argument("--scale", choices=SCALES, default="small", help=f"{about} (default: %(default)s)")


def _whole(text: str, least: int = 0) -> int:
    # more digits than any number of steps, threads or seeds has
    if not text.isdecimal() or len(text) > 9 or int(text) < least:
        raise argparse.ArgumentTypeError(f"is '{text}'; it must be a whole number of at least {least}, under 10^9")
    return int(text)


def _positive(text: str) -> int:
    return _whole(text, 1)


def _add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="only these rows (default: all)")
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="only these scenes (default: the scale's)")
    note = f"seeds of each: {SEED}, {SEED + 1}, ..."
    parser.add_argument("--seeds", type=_positive, default=1, metavar="N", help=note)


def _jobs(args: argparse.Namespace) -> list[Job]:
    """List the trainings that `_add_jobs` read, the cheapest first."""
    return jobs_of(args.scale, args.rows or ROWS, args.scenes, range(SEED, SEED + args.seeds))


def _add_results(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR", help="the folder of results (default: %(default)s)"
    )


def _add_data(parser: argparse.ArgumentParser) -> None:
    root = os.environ.get("POP_DATA", "data")
    note = "the folder that holds the scenes (default: $POP_DATA, else data)"
    parser.add_argument("--data", type=Path, default=Path(root), metavar="DIR", help=note)


def _add_work(parser: argparse.ArgumentParser, note: str) -> None:
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR", help=note)


def _add_backend(parser: argparse.ArgumentParser, note: str) -> None:
    parser.add_argument("--backend", choices=("auto", *backend_names()), default="auto", help=note)


def _add_training(parser: argparse.ArgumentParser) -> None:
    """Add what says how rows are trained, and changes nothing of what they are."""
    _add_scale(parser)
    _add_data(parser)
    _add_results(parser)
    _add_work(parser, "the folder of checkpoints; that of a finished row can be removed (default: %(default)s)")
    note = "the folder of splats and renders of finished rows, to be published (default: published in --work)"
    parser.add_argument("--published", type=Path, metavar="DIR", help=note)
    note = "CPU threads, 0 for all cores (default: 1)"
    parser.add_argument("--threads", type=_whole, default=1, metavar="N", help=note)
    _add_backend(parser, "the backend, as for pop train (default: %(default)s)")
    note = "steps between checkpoints, which a kill can cost (default: the scale's, 500 or so)"
    parser.add_argument("--checkpoint-every", type=_whole, metavar="STEPS", help=note)
    note = "steps between two points of the curves (default: the scale's, 100 or so)"
    parser.add_argument("--log-every", type=_positive, metavar="STEPS", help=note)
    for net, name in (("vgg", "VGG16"), ("alex", "AlexNet")):
        note = f"weights of LPIPS on {name}: one merged file, or backbone and linear layers"
        parser.add_argument(f"--lpips-{net}", nargs="+", default=[], metavar="FILE", help=note)
    parser.add_argument("--keep-ply", action="store_true", help="keep the Gaussians of finished rows in --work")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep their checkpoints too")
    note = "the machine also does other work: seconds are recorded, but never compared"
    parser.add_argument("--untimed", action="store_true", help=note)


def _training_words(args: argparse.Namespace) -> list[str]:
    """Say what `_add_training` read as words again, but for the scale; paths absolute."""
    folders = {name: getattr(args, name) for name in ("data", "results", "work", "published")}
    words = [w for name, folder in folders.items() if folder is not None for w in (f"--{name}", str(folder.absolute()))]
    words += ["--threads", str(args.threads), "--backend", args.backend]
    for name in ("checkpoint_every", "log_every"):
        value = getattr(args, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", str(value)]
    for name in ("lpips_vgg", "lpips_alex"):
        files = [str(Path(file).absolute()) for file in getattr(args, name)]
        words += [f"--{name.replace('_', '-')}", *files] if files else []
    for name in ("keep_ply", "keep_checkpoints", "untimed"):
        words += [f"--{name.replace('_', '-')}"] if getattr(args, name) else []
    return words


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
    pop-repro queue --scale paper --data DATA --check     the hours of each row, and what is missing here
"""


def run(words: Sequence[str]) -> int:
    """Train one row and print the file that has its result."""
    parser = _parser_of("run", _RUN)
    parser.add_argument("row", metavar="ROW", help="a file of configs: pop, gsplat, 3dgs, l2_blur, ...")
    parser.add_argument("scene", metavar="SCENE", help="one of the scale's: fox, bonsai_800, garden, ...")
    parser.add_argument("--seed", type=int, default=SEED, help="seed of every random number (default: %(default)s)")
    parser.add_argument("--again", action="store_true", help="train a finished row again, and replace its result")
    _add_training(parser)
    args = parser.parse_args(words)
    from paper_repro.train_row import Options, finished, train_row

    job = job_named(args.row, args.scene, args.scale, args.seed)
    before = None if args.again else finished(job, args.results)
    if before is None:
        chosen = {field.name: getattr(args, field.name) for field in fields(Options) if field.name in args}
        lists = {name: tuple(chosen[name]) for name in ("lpips_vgg", "lpips_alex")}
        train_row(job, Options(**{**chosen, **lists}))
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
    parser = _parser_of("queue", _QUEUE)
    _add_jobs(parser)
    parser.add_argument("--nice", type=_whole, default=0, metavar="N", help="nice value, 0 to 19")
    parser.add_argument("--commit", action="store_true", help="commit each result in git")
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument("--list", action="store_true", help="list what is missing, in order, and train nothing")
    note = "say the hours and what of data, disk, memory and GPU is lacking, and train nothing; scale paper begins so"
    instead.add_argument("--check", action="store_true", help=note)
    _add_training(parser)
    args = parser.parse_args(words)
    from paper_repro.queue import run_queue

    jobs = _jobs(args)
    if args.list:
        print("\n".join(str(job) for job in jobs if not job.is_done(args.results)))
        return 0
    if args.check or args.scale == "paper":
        ready = _ready([job for job in jobs if not job.is_done(args.results)], args)
        if args.check or not ready:
            return 0 if ready else EXIT_INCOMPLETE
    if args.nice:
        os.nice(args.nice)
    outcome = run_queue(jobs, args.results, _training_words(args), args.threads, args.commit)
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
    from paper_repro.queue import hours_by_row, lacking

    print("\n".join([f"{len(missing)} trainings to go", *hours_by_row(missing)]), flush=True)
    found = lacking(missing, args.data, args.work, args.backend)
    print("\n".join(["lacking:", *(f"  {line}" for line in found)] if found else ["nothing is lacking"]), flush=True)
    return not found


_SHOWN: Final = 5  # differences
_VERIFY: Final = """
    pop-repro verify pop fox --data DATA                  all steps; the same command continues after a stop
    pop-repro verify pop fox --data DATA --steps 2000     the first 2,000, with the first look at held-out views
"""


def verify(words: Sequence[str]) -> int:
    """Train a finished row again and print whether its result comes out."""
    parser = _parser_of("verify", _VERIFY)
    parser.add_argument("row", metavar="ROW", help="a row with a result")
    parser.add_argument("scene", metavar="SCENE", help="one of the scale's: fox, bonsai_800, garden, ...")
    parser.add_argument("--seed", type=int, default=SEED, help="of the result (default: %(default)s)")
    parser.add_argument("--steps", type=_positive, metavar="N", help="only the first steps (default: all)")
    _add_scale(parser)
    _add_data(parser)
    _add_results(parser)
    _add_work(parser, "the folder that the commit is cloned and trained in (default: %(default)s)")
    _add_backend(parser, "what takes the steps (default: what took those of the result)")
    args = parser.parse_args(words)
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
    if made.begun is not None:
        print(f"the first steps of the result were taken at another commit, {made.begun[:7]}, which may be why")
    print("\n".join(f"  {difference}" for difference in made.differences[:_SHOWN]))
    return EXIT_INCOMPLETE


_STATUS: Final = """
    pop-repro status --scale small
    pop-repro status --scale paper --rows pop gsplat --seeds 3
"""
_TABLE: Final = """
    pop-repro table 1 --scale small                         to read, as Markdown
    pop-repro table 1 --scale small --out out               table_1.md, table_1.tex and table_1.csv
    pop-repro table beyond --scale small                    what goes beyond the paper
"""
_FIGURE: Final = """
    pop-repro figure 7 --scale small --out out              figure_7.svg, figure_7.png and the numbers in figure_7.csv
    pop-repro figure 5 --scale small --work WORK            of the renders that finished rows keep in their work folder
    pop-repro figure 3 --scale small --data DATA            trains 1,000 steps, on the CPU, from a 3DGS model
"""
_CLAIMS: Final = """
    pop-repro claims --scale small                          each claim, its verdict, its intervals, what would decide it
"""


def status(words: Sequence[str]) -> int:
    """Print how far the runs of a scale are."""
    parser = _parser_of("status", _STATUS)
    _add_scale(parser)
    _add_results(parser)
    _add_work(parser, "the checkpoints (default: %(default)s)")
    _add_jobs(parser)
    args = parser.parse_args(words)
    from paper_repro.queue import progress

    print("\n".join(progress(_jobs(args), existing_folder(args.results), args.work)))
    return 0


def table(words: Sequence[str]) -> int:
    """Print a table, or write it in three formats."""
    parser = _parser_of("table", _TABLE)
    parser.add_argument("number", metavar="N", choices=("1", "2", "3", "4", "5", "beyond"), help="1 to 5, or beyond")
    _add_scale(parser)
    _add_results(parser)
    _add_data(parser)
    note = "write table_N.md, table_N.tex and table_N.csv there instead of printing"
    parser.add_argument("--out", type=Path, metavar="DIR", help=note)
    args = parser.parse_args(words)
    from paper_repro import tables
    from paper_repro.table_formats import csv_text, latex, markdown

    results, absent = read_all(args.scale, existing_folder(args.results)), _absent(args.scale, args.data)
    if args.number == "beyond":
        made = tables.beyond(args.scale, results, absent)
    else:
        made = tables.table(int(args.number), args.scale, results, absent)
    if args.out is None:
        print(markdown(made))
        return 0
    for suffix, render in (("md", markdown), ("tex", latex), ("csv", csv_text)):
        _write(args.out / f"table_{args.number}.{suffix}", render(made))
    return 0


def figure(words: Sequence[str]) -> int:
    """Draw a figure."""
    from paper_repro.figures import FIGURES, draw

    parser = _parser_of("figure", _FIGURE)
    titles = "; ".join(f"{number}: {title}" for number, (_, _, title) in FIGURES.items())
    parser.add_argument("id", metavar="ID", help=f"its number in the paper: {titles}")
    _add_scale(parser)
    _add_results(parser)
    _add_data(parser)
    _add_work(parser, "pictures of finished rows (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("out"), metavar="DIR", help="where to write (default: out)")
    args = parser.parse_args(words)

    for path in draw(args.id, args.scale, existing_folder(args.results), args.out, args.work, args.data):
        print(path)
    return 0


def claims(words: Sequence[str]) -> int:
    """Print the verdict on each claim."""
    parser = _parser_of("claims", _CLAIMS)
    _add_scale(parser)
    _add_results(parser)
    parser.add_argument("--out", type=Path, metavar="DIR", help="write claims.md there instead of printing")
    args = parser.parse_args(words)
    from paper_repro.status import markdown

    text = markdown(args.scale, read_all(args.scale, existing_folder(args.results)))
    if args.out is None:
        print(text)
    else:
        _write(args.out / "claims.md", text)
    return 0


def _absent(scale: str, data: Path) -> list[str]:
    """List the scenes of a scale that are not under the data root; nothing is known where there is no root."""
    if not data.is_dir():
        return []
    absent: list[str] = []
    for name in scale_named(scale).factors:
        try:
            _ = name in MADE or find_folder(SCENES[name], data)
        except PopError:
            absent.append(name)
    return absent


def _write(path: Path, text: str) -> None:
    from pop_fast.io.atomic import write_file

    write_file(path, text.rstrip("\n") + "\n")
    print(path)


_DATA: Final = """
    pop-repro data check --data DATA                      every scene of the paper and the further ones
    pop-repro data check --data DATA --scenes garden fox
"""


def data_check(words: Sequence[str]) -> int:
    """Say of each scene whether it is there as the protocol has it."""
    parser = _parser_of("data check", _DATA)
    _add_data(parser)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="only these (default: all)")
    args = parser.parse_args(words)
    from paper_repro.data_check import check_scene, table

    # those that the program makes are made where they are needed
    chosen = args.scenes or [name for name in SCENES if name not in MADE]
    found = [check_scene(scene_named(name), args.data) for name in chosen]
    print("\n".join(table(found, args.data)))
    return 0 if all(item.status == "ok" for item in found) else EXIT_INCOMPLETE


# each with what runs it and what it does
COMMANDS: Final = {
    "run": (run, "train one row on one scene, or resume it"),
    "queue": (queue, "train all missing rows of a scale, the cheapest first"),
    "verify": (verify, "train a finished row again at its commit, and compare the bits"),
    "status": (status, "say which rows of a scale are done"),
    "table": (table, "make one of the paper's tables from the results"),
    "figure": (figure, "draw one of the paper's figures from the results"),
    "claims": (claims, "judge the paper's claims by the results"),
    "data check": (data_check, "say which scenes are present and complete, and where to get the rest"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and turn what went wrong into one line and an exit status.

    Args:
        argv: the words after `pop-repro`; the process's own when None.

    Returns:
        As `pop_fast.cli.main`, and 1 where something failed;
        of `run` also 69 where this version cannot train the row, and 75 where another process trains it.
    """
    return guarded("pop-repro", _run, argv, "stopped; the same command continues from the last checkpoint")


def _run(words: list[str]) -> int:
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words or words[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS)) + 2
        commands = "\n".join(f"  {name:<{width}}{about}" for name, (_, about) in COMMANDS.items())
        print(_TEXT.format(commands=commands, snakefile="paper_repro/Snakefile"))
        return 0
    if words[0] in ("-V", "--version"):
        from importlib.metadata import version

        print(f"pop-repro {version('pop-splatting')}")
        return 0
    for length in (2, 1):
        name = " ".join(words[:length])
        if name in COMMANDS:
            return COMMANDS[name][0](words[length:])
    names = {name.split()[0]: name for name in COMMANDS}
    near = difflib.get_close_matches(words[0], names, n=1, cutoff=0.5)
    hint = f"did you mean 'pop-repro {names[near[0]]}'?" if near else "see 'pop-repro --help'"
    print(f"pop-repro: error: '{words[0]}' is not a subcommand; {hint}", file=sys.stderr)
    return EXIT_BAD_INPUT
