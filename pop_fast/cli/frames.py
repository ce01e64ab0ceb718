"""`pop frames`: take photographs out of a video."""

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
    pop frames walk.mp4                          writes walk_frames, up to 150 photographs
    pop frames walk.mp4 --count 80 --out photos && pop train photos --preset quick
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Take photographs out of a video: the sharpest frame of every stretch of time, none where the camera rests."""

    video: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VIDEO")]
    """The video."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """The folder to make; by default VIDEO's name with _frames."""
    count: int = 150
    """Number of photographs, at most."""
    max_size: int = 0
    """Longest side of the photographs, px; 0 leaves them as they are."""
    overwrite: bool = False
    """Replace an earlier result; a folder that holds anything else is left alone."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "frames", examples=_EXAMPLES)
    from pop_fast.data.unpack import frames_folder, take_frames

    out = args.out or frames_folder(args.video)
    with bars() as progress:
        found = take_frames(args.video, out, args.count, args.max_size, progress, overwrite=args.overwrite)
    resting = f"; the camera rested in {found.alike} stretches" if found.alike else ""
    print(f"{len(found.frames)} of {found.of:,} frames{resting} -> {found.folder}{found.lost}")
    print(f"next: pop train {quote(str(found.folder))}")
    return 0
