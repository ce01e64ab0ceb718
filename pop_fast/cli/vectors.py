"""`pop vectors`: the conformance kit's portable vectors, for renderers that are not written in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import tyro

from pop_fast.cli import parse
from pop_fast.io.atomic import folder_atomically

_EXAMPLES: Final = """
    pop vectors export vectors             scenes with expected images and gradients; vectors/index.json explains them
    pop vectors check vectors my_results   compare the results of a port with them
"""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write scenes with expected images, gradients, dominant Gaussians and margins; index.json explains every array."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The folder to make."""
    overwrite: bool = False
    """Replace an existing folder."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """Hold a port's results to the vectors.

    Exit status 0 when every array that is there is as good as rounding lets it be, 1 when one is not.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """A folder that 'pop vectors export' wrote."""
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]
    """The port's results: NAME.npz or NAME.json for each vector that it draws."""
    dtype: Literal["float32", "float64"] = "float32"
    """The precision that the port computes in."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Write conformance vectors for renderers in other languages, or check the results of one."""

    action: tyro.conf.OmitSubcommandPrefixes[
        Annotated[Export, tyro.conf.subcommand("export")] | Annotated[Check, tyro.conf.subcommand("check")]
    ]


_NAMED: Final = 8  # names that a line gives


def run(argv: Sequence[str]) -> int:
    action = parse(Args, argv, "vectors", examples=_EXAMPLES).action
    if isinstance(action, Check):
        return _check(action)
    from pop_ref.conformance.vectors import export

    with folder_atomically(action.folder, action.overwrite) as folder:
        names = export(folder)
    print(f"{len(names)} vectors -> {action.folder}; {action.folder / 'index.json'} says what every array means")
    return 0


def _check(args: Check) -> int:
    from pop_ref.conformance.vector_check import check

    found = check(args.folder, args.results, args.dtype)
    arrays = dict.fromkeys(verdict.array for verdict in found.verdicts)
    width = max(map(len, arrays)) + 2
    for array in arrays:
        verdicts = [verdict for verdict in found.verdicts if verdict.array == array]
        failed = [verdict for verdict in verdicts if not verdict.passed]
        print(f"{array:<{width}}{len(verdicts) - len(failed)} of {len(verdicts)} vectors pass")
        for verdict in failed:
            off = f"off by {verdict.worst:.3g} {verdict.unit}, allowed {verdict.allowed:.3g}"
            print(f"  {verdict.vector}: {off}; {verdict.where}")
    for title, names in (("not there", found.absent), ("no result for", found.missing), ("unknown", found.strange)):
        if names:
            more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
            print(f"{title}, not judged: {', '.join(names[:_NAMED])}{more}")
    failing = f"{len(found.failed)} of {len(found.verdicts)} arrays fail"
    print(failing if found.failed else "all arrays that are there pass")
    return 1 if found.failed else 0
