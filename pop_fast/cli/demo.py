"""`pop demo`: write the built-in demo capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Annotated, Final

import tyro

from pop_fast.cli import parse
from pop_fast.io.heartbeat import bars

_EXAMPLES: Final = """
    pop demo scene && pop train scene --minutes 2
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Write the demo capture: a ray-traced still life, photographed from an orbit, as an ordinary COLMAP capture."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """The folder to make."""
    seed: int = 0
    """Seed of textures, places, camera jitter and noise; the same seed gives the same bytes."""
    views: int = 60
    """Number of photographs."""
    width: int = 320
    """Width of a photograph, px."""
    height: int = 240
    """Height of a photograph, px."""
    overwrite: bool = False
    """Replace an existing folder."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "demo", examples=_EXAMPLES)
    from pop_fast.demo import make_demo

    with bars() as progress:
        folder = make_demo(
            args.out, args.seed, args.views, args.width, args.height, progress=progress, overwrite=args.overwrite
        )
    print(f"{args.views} photographs of {args.width} x {args.height} px -> {folder}")
    print(f"next: pop train {quote(str(folder))} --minutes 2")
    return 0
