"""`pop compare`: several results side by side, and files of splats among them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import tyro

from pop_fast.cli import parse
from pop_fast.cli.options import CaptureArguments
from pop_fast.errors import PopError
from pop_fast.train.load_result import load_splat
from pop_fast.train.results import read_config

_EXAMPLES: Final = """
    pop compare out/scene_pop out/scene_adc
    pop compare out/scene_pop scene.sog scene.spz --capture scene    files are measured as 'pop eval' does
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Put several results side by side: quality, Gaussians, Gaussians per pixel, opacities, seconds.

    Of a result folder these are the numbers that its training left. The file of a splat is measured; the options say on
    which photographs, by default of the size that the results beside it were trained on.
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

    args = replace(args, factor=_factor(args))
    found = [_stats(path, args) for path in args.results]
    unfinished = [path for path, stats in zip(args.results, found, strict=True) if "psnr" not in stats]
    why = "has no statistics yet; train to the first evaluation, or run pop eval"
    if len(unfinished) == len(found):
        raise PopError(f"{unfinished[0]}: {why} {unfinished[0]}")
    for path in unfinished:
        print(f"note: {path}: {why} {path}", file=sys.stderr)
    rows = [row(stats) for stats in found]
    print(markdown(rows) if args.markdown else plain(rows))
    return 0


def _factor(args: Args) -> int | None:
    """Return what photographs are shrunk by before files are measured: as asked, else as all of the results say."""
    factors = {read_config(path).factor for path in args.results if not path.is_file()}
    return factors.pop() if args.factor is None and len(factors) == 1 else args.factor


def _stats(path: Path, args: Args) -> dict[str, Any]:
    """Return what a result's training left of numbers, or measure the file of a splat."""
    from pop_fast.cli.eval import measured
    from pop_fast.view.report.source import read_last_stats

    if path.is_file():
        capture, stats = measured(load_splat(path), args, [])
        return {**stats, "capture": capture, "method": path.name}
    config = read_config(path)
    stats = read_last_stats(path) or {"capture": Path(config.data).name, "method": config.method}
    return {**stats, "max_steps": config.max_steps}
