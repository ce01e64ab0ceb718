"""`pop compare`: several results side by side."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import tyro

from pop_fast.cli import EXIT_INCOMPLETE
from pop_fast.cli.arguments import parse
from pop_fast.errors import PopError

_EXAMPLES: Final = """
    pop compare out/scene_pop out/scene_adc
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Put several results side by side: quality, Gaussians, Gaussians per pixel, opacities, seconds."""

    results: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RESULT [RESULT ...]")]
    """Folders that 'pop train' wrote."""
    markdown: bool = False
    """Print a Markdown table."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "compare", examples=_EXAMPLES)
    if not args.results:
        raise PopError("nothing to compare; name one or more result folders")
    from pop_fast.view.report.compare import markdown, plain, row

    found = [(folder, _stats(folder)) for folder in args.results]
    rows = [row(stats) for _, stats in found if stats is not None]
    without = [str(folder) for folder, stats in found if stats is None]
    fix = "train to the first evaluation, or run pop eval"
    if not rows:
        raise PopError(f"{', '.join(without)}: nothing has been measured yet; {fix}")
    print(markdown(rows) if args.markdown else plain(rows))
    for folder in without:
        print(f"pop: {folder}: left out, as nothing has been measured yet; {fix}", file=sys.stderr)
    return EXIT_INCOMPLETE if without else 0


def _stats(folder: Path) -> dict[str, object] | None:
    """Read the statistics of a run; None where it has none yet."""
    from pop_fast.train.results import read_config
    from pop_fast.view.report.source import read_last_stats

    planned = read_config(folder).max_steps
    stats = read_last_stats(folder)
    return {**stats, "max_steps": planned} if stats else None
