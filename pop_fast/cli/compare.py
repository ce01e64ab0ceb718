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
    pop compare out/scene_pop out/scene_gsplat
    pop compare out/scene_pop scene.sog scene.spz    files are measured as 'pop eval' does
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Put several results side by side: quality, Gaussians, Gaussians per pixel, opacities, seconds.

    Of a result folder these are the numbers that its training left. The file of a splat is measured; the options say on
    which photographs, by default those that the results beside it were trained on, at their size.
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

    args = replace(args, **_of_results(args))
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


def _of_results(args: Args) -> dict[str, Any]:
    """Return by which photographs files are measured, as far as nothing is asked: those that all of the results had."""
    configs = [read_config(path) for path in args.results if not path.is_file()]
    had: dict[str, set[Any]] = {
        "capture": {Path(config.data) for config in configs},
        "factor": {config.factor for config in configs},
        "test_every": {config.test_every for config in configs},
    }
    return {name: of.pop() for name, of in had.items() if len(of) == 1 and getattr(args, name) is None}


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
