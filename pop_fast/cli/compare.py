"""`pop compare`: several results side by side, and files of splats among them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from pop_fast.cli import parse, printable
from pop_fast.cli.options import CaptureArguments
from pop_fast.errors import PopError
from pop_fast.train.load_result import CaptureRecord, Splat, load_splat, read_record, unbundled
from pop_fast.train.results import read_config

_EXAMPLES: Final = """
    pop compare out/scene_pop out/scene_gsplat
    pop compare out/scene_pop scene.sog scene.spz    files are measured as 'pop eval' does
"""

# settings of a run that say what its held-out views look like
_PHOTOGRAPHS: Final = ("data", "factor", "test_every", "background", "resize")


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Put several results side by side: quality, Gaussians, Gaussians per pixel, opacities, seconds.

    Of a result folder these are the numbers that its training left. The file of a splat is measured; the options say on
    which photographs, by default those of the results that are compared with it.
    """

    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|FILE [RESULT|FILE ...]")]
    """Folders that 'pop train' wrote, and files of splats."""
    markdown: bool = False
    """Print a Markdown table."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "compare", examples=_EXAMPLES)
    if not args.results:
        raise PopError("nothing to compare; name one or more result folders")
    from pop_fast.view.report.source import markdown, plain, row

    runs = [path for path in args.results if not path.is_file() and unbundled(path) is None]
    found = [_of_run(path) if path in runs else _of_file(path, runs, args) for path in args.results]
    unfinished = [path for path, stats in zip(args.results, found, strict=True) if "psnr" not in stats]
    why = "has no statistics yet; train to the first evaluation, or run pop eval"
    if len(unfinished) == len(found):
        raise PopError(f"{unfinished[0]}: {why} {unfinished[0]}")
    for path in unfinished:
        print(f"note: {path}: {why} {path}", file=sys.stderr)
    rows = [[printable(cell) for cell in row(stats)] for stats in found]
    print(markdown(rows) if args.markdown else plain(rows))
    return 0


def _of_run(path: Path) -> dict[str, Any]:
    """Return what a result's training left of numbers."""
    from pop_fast.view.report.source import read_last_stats

    config = read_config(path)
    stats = read_last_stats(path) or {"capture": Path(config.data).name, "method": config.method}
    return {**stats, "max_steps": config.max_steps}


def _of_file(path: Path, runs: Sequence[Path], args: Args) -> dict[str, Any]:
    """Measure the file of a splat."""
    from pop_fast.cli.eval import measured

    capture, stats = measured(_photographed_as(load_splat(path), runs), args, [])
    return {**stats, "capture": capture, "method": path.name}


def _photographed_as(splat: Splat, runs: Sequence[Path]) -> Splat:
    """Return a file's splat with what all runs that it is compared with agree on about their photographs."""
    configs = [read_config(run) for run in runs]
    records = [replace(read_record(run) or CaptureRecord(), chosen=[], cameras={}) for run in runs]
    agreed = {name: getattr(configs[0], name) for name in _PHOTOGRAPHS if configs}
    shared = {name: value for name, value in agreed.items() if all(getattr(c, name) == value for c in configs)}
    changed = replace(splat, config=replace(splat.config, **shared))
    if not runs or any(record != records[0] for record in records):
        return changed
    # without a step, the colours of a lone checkpoint are not taken to be those of this run's schedule
    return replace(changed, folder=runs[0], step=None if splat.folder is None else splat.step)
