"""`pop report`: write report.html again from the files of a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from pop_fast.cli import parse
from pop_fast.cli.options import CaptureArguments, open_with_bars
from pop_fast.train.load_result import load_splat


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Write report.html into a result folder, from the files in it; also for a run that was stopped.

    --check renders first what older and stopped runs lack, with the capture: depth, the orbit, floaters, exposure. The
    report's commands name --capture, where the capture has moved.
    """

    result: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT")]
    """A folder that 'pop train' wrote."""
    check: bool = False
    """Also render and measure what only the report shows; needs the capture."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "report")
    if args.check:
        from pop_fast.cli.export import checked

        splat = load_splat(args.result)
        checked(args.result, splat, *open_with_bars(splat, args))
    from pop_fast.view.report import write_report

    print(write_report(args.result, args.capture))
    return 0
