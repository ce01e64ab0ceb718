"""`pop report`: write report.html again from the files of a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pop_fast.cli.arguments import parse


@dataclass(frozen=True, kw_only=True)
class Args:
    """Write report.html into a result folder, from the files in it; also for a run that was stopped."""

    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
    """A folder that 'pop train' wrote."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "report")
    from pop_fast.view.report import write_report

    print(write_report(args.result))
    return 0
