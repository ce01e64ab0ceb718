"""`pop build-cpu`: compile the CPU kernels for this machine's processor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pop_fast.cli.arguments import parse
from pop_fast.compiled import why_not
from pop_fast.compiled.build import BuildError, build
from pop_fast.errors import PopError

_EXAMPLES: Final = """
    pop build-cpu             backend "compiled", which `pop train` takes by itself from then on
    CXX=clang++ pop build-cpu
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Compile the CPU kernels with g++, clang++ or the compiler that CXX names. Nothing else compiles them but `make`.

    It takes some seconds and makes training about three times as fast. They are compiled for exactly this processor,
    and have to be compiled again after an update.
    """

    verbose: bool = False
    """Show the compiler's command."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "build-cpu", examples=_EXAMPLES)
    try:
        library = build(args.verbose)
    except BuildError as error:
        first, *rest = str(error).splitlines()
        print("\n".join(rest), end="\n" if rest else "")
        raise PopError(first) from error
    reason = why_not()
    if reason is not None:
        raise PopError(reason)
    print(library)
    return 0
