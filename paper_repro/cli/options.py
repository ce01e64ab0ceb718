"""Options that several subcommands of `pop-repro` share."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Final

from paper_repro.scales import SCALES
from pop_fast.api.backend import backend_names

__all__ = ["add_backend", "add_data", "add_results", "add_scale", "add_training", "training_words"]

RESULTS: Final = Path(__file__).resolve().parents[1] / "results"
WORK: Final = Path(__file__).resolve().parents[1] / "work"


def add_scale(parser: argparse.ArgumentParser) -> None:
    """Add --scale."""
    about = "; ".join(f"{scale.name}: {scale.about}" for scale in SCALES.values())
    parser.add_argument("--scale", choices=SCALES, default="small", help=f"{about} (default: %(default)s)")


def add_results(parser: argparse.ArgumentParser) -> None:
    """Add --results."""
    parser.add_argument(
        "--results", type=Path, default=RESULTS, metavar="DIR", help="the folder of results (default: %(default)s)"
    )


def add_data(parser: argparse.ArgumentParser) -> None:
    """Add --data."""
    root = os.environ.get("POP_DATA", "data")
    note = "the folder that holds the scenes (default: $POP_DATA, else data)"
    parser.add_argument("--data", type=Path, default=Path(root), metavar="DIR", help=note)


def add_backend(parser: argparse.ArgumentParser, note: str) -> None:
    """Add --backend."""
    parser.add_argument("--backend", choices=("auto", *backend_names()), default="auto", help=note)


def add_training(parser: argparse.ArgumentParser) -> None:
    """Add what says how rows are trained, and changes nothing of what they are."""
    add_scale(parser)
    add_data(parser)
    add_results(parser)
    note = "the folder of checkpoints; of a finished row it can be removed (default: %(default)s)"
    parser.add_argument("--work", type=Path, default=WORK, metavar="DIR", help=note)
    note = "the folder of splats and renders of finished rows, to be published (default: published in --work)"
    parser.add_argument("--published", type=Path, metavar="DIR", help=note)
    parser.add_argument("--threads", type=int, default=1, metavar="N", help="CPU threads, 0 for all cores (default: 1)")
    add_backend(parser, "what takes the steps, as for pop train (default: %(default)s)")
    note = "steps that a kill can cost (default: the scale's, 500 or so)"
    parser.add_argument("--checkpoint-every", type=int, metavar="STEPS", help=note)
    note = "steps between two points of the curves (default: the scale's, 100 or so)"
    parser.add_argument("--log-every", type=int, metavar="STEPS", help=note)
    for net, name in (("vgg", "VGG16"), ("alex", "AlexNet")):
        note = f"weights of LPIPS on {name}: one merged file, or backbone and linear layers"
        parser.add_argument(f"--lpips-{net}", nargs="+", default=[], metavar="FILE", help=note)
    parser.add_argument("--keep-ply", action="store_true", help="keep the Gaussians of finished rows in --work")
    parser.add_argument("--keep-checkpoints", action="store_true", help="keep their checkpoints too")
    note = "the machine has other work meanwhile: seconds are kept with the result, and compared with no other's"
    parser.add_argument("--untimed", action="store_true", help=note)


def training_words(args: argparse.Namespace) -> list[str]:
    """Say what `add_training` read as words again, but for the scale; paths absolute."""
    words = [
        "--data",
        str(args.data.absolute()),
        "--results",
        str(args.results.absolute()),
        "--work",
        str(args.work.absolute()),
    ]
    words += [] if args.published is None else ["--published", str(args.published.absolute())]
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
