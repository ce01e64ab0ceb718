"""`pop-repro data check`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from paper_repro.cli import EXIT_INCOMPLETE, parser_of
from paper_repro.cli.options import add_data

__all__ = ["data_check"]

_EXAMPLES: Final = """
    pop-repro data check --data DATA                      every scene of the paper and the further ones
    pop-repro data check --data DATA --scenes garden fox
"""


def data_check(words: Sequence[str]) -> int:
    """Say of each scene whether it is there as the protocol has it."""
    parser = parser_of("data check", _EXAMPLES)
    add_data(parser)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="these alone (default: all)")
    args = parser.parse_args(words)
    from paper_repro.data_check import check_scene, table
    from paper_repro.scenes import MADE, SCENES, scene_named

    # those that the program makes are made where they are needed
    chosen = args.scenes or [name for name in SCENES if name not in MADE]
    found = [check_scene(scene_named(name), args.data) for name in chosen]
    print("\n".join(table(found, args.data)))
    return 0 if all(item.status == "ok" for item in found) else EXIT_INCOMPLETE
