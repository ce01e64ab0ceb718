"""`pop sfm`: find the cameras of a folder of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from shlex import quote
from typing import Annotated, Final, Literal

import tyro

from pop_fast.cli import parse
from pop_fast.data.capture import SfmOptions
from pop_fast.io.heartbeat import bars

_EXAMPLES: Final = """
    pop sfm photos                 writes photos/sparse/0
    pop sfm photos --out scene     a new capture, with copies of the photographs
"""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Find the cameras and sparse points of a folder of photographs (structure from motion, pycolmap, on the CPU)."""

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """The folder with the photographs."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Make a capture here; by default sparse/0 is written next to the photographs."""
    max_size: int = SfmOptions.max_size
    """Longest side of the images in the search for features, px."""
    camera_model: str = SfmOptions.camera_model
    """COLMAP's name of the lens model: SIMPLE_RADIAL, OPENCV, OPENCV_FISHEYE, ..."""
    single_camera: bool | None = SfmOptions.single_camera
    """All photographs share one camera; by default if all have the same size and, by EXIF, the same lens."""
    matcher: Literal["auto", "exhaustive", "sequential"] = SfmOptions.matcher
    """Compare all pairs of photographs, or each with its neighbours by name; "auto" compares up to 60 with all."""
    seed: int = SfmOptions.seed
    """Of every random choice."""
    overwrite: bool = False
    """Replace an earlier result of pop sfm; a folder that holds anything else is left alone."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "sfm", examples=_EXAMPLES)
    from pop_fast.data import run_sfm
    from pop_fast.data.load import refuse_several
    from pop_fast.data.sfm import photo_folder
    from pop_fast.io.images import unreadable_photographs

    if args.photos.is_dir():
        refuse_several(args.photos, args.out)
    with bars() as progress:
        options = {field.name: getattr(args, field.name) for field in fields(SfmOptions)}
        found = run_sfm(args.photos, args.out, progress, overwrite=args.overwrite, **options)
    left = unreadable_photographs(photo_folder(args.photos))
    for note in (*found.notes, *([left] if left else [])):
        print(f"note: {note}")
    print(
        f"{found.registered} of {found.photographs} photographs placed, {found.points:,} points, "
        f"mean reprojection error {found.reprojection_error:.2f} px -> {found.capture}"
    )
    print(f"next: pop train {quote(str(found.capture))}")
    return 0
