"""`pop export`: a result as PLY, `.splat` or a folder as Inria's trainer leaves it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import tyro

from pop_fast.cli.arguments import parse
from pop_fast.cli.capture_options import CaptureArguments, open_with_bars
from pop_fast.errors import PopError
from pop_fast.train.load_result import Splat, load_splat, read_record

_EXAMPLES: Final = """
    pop export out/scene_pop --out scene.ply                 for any viewer, in the capture's own world frame
    pop export out/scene_pop --out scene.ply --drop-invisible
    pop export out/scene_pop --out scene.splat               32 bytes a Gaussian, colours without view dependence
    pop export out/scene_pop --out scene_inria --layout inria
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Write a splat as PLY (Inria's 62 properties), .splat, or a folder in Inria's layout."""

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|PLY")]
    """What to export."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
    """Where to: a .ply, a .splat, or with --layout inria a new folder."""
    layout: Literal["file", "inria"] = "file"
    """"inria" writes point_cloud/, cameras.json, cfg_args, and held-out renders, as many tools expect."""
    frame: Literal["capture", "training"] | None = None
    """World frame of the output; by default the capture's own for a result, and the file's own for a lone file."""
    drop_invisible: bool = False
    """Leave out Gaussians with opacity under 1/255: no renderer shows them."""
    overwrite: bool = False
    """Replace the file, or the folder where it holds nothing but an earlier export."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "export", examples=_EXAMPLES)
    if args.layout == "file":
        check_file(args)
    splat = load_splat(args.splat)
    if args.layout == "inria":
        from pop_fast.view.inria import write_inria_folder

        capture, config = open_with_bars(splat, args)
        write_inria_folder(replace(splat, config=config), capture, args.out, args.overwrite)
        print(f"{len(splat.params['means']):,} Gaussians, {len(capture.views)} cameras -> {args.out}")
        return 0
    splat = in_frame(splat, args)
    if args.drop_invisible:
        splat = without_invisible(splat)
    from pop_fast.io.ply import save_ply, save_splat

    n = len(splat.params["means"])
    if args.out.suffix.lower() == ".splat":
        save_splat(args.out, splat.params)
    else:
        save_ply(args.out, splat.params, splat.config.antialiased)
    print(f"{n:,} Gaussians, {args.out.stat().st_size / 2**20:.1f} MiB -> {args.out}")
    return 0


def check_file(args: Args) -> None:
    """Check that one file may be written where it is asked for.

    Raises:
        PopError: another kind of file, something that is not to be replaced, or the splat itself.
    """
    if args.out.suffix.lower() not in (".ply", ".splat"):
        raise PopError(f"{args.out}: the name must end in .ply or .splat; for a folder give --layout inria")
    if args.out.is_dir():
        raise PopError(f"{args.out}: a folder of this name is in the way; choose another --out")
    if args.out.exists() and args.splat.exists() and args.out.samefile(args.splat):
        raise PopError(f"{args.out}: is the splat that is read; choose another --out")
    if args.out.exists() and not args.overwrite:
        raise PopError(f"{args.out}: exists; pass --overwrite or another --out")


def in_frame(splat: Splat, args: Args) -> Splat:
    """Move a splat into the frame that was asked for.

    Raises:
        PopError: the capture's frame was asked for and nothing says how it relates to the splat's.
    """
    wanted = args.frame or ("capture" if splat.folder is not None else "training")
    if wanted == "training" or args.own_frame or not splat.config.normalize:
        return splat
    record = read_record(splat.folder)
    if args.capture is None and record is not None:
        transform = np.array(record.world_transform)
    else:
        transform = open_with_bars(splat, args)[0].world_transform
    from pop_fast.data import to_capture_frame

    return replace(splat, params=to_capture_frame(splat.params, transform))


def without_invisible(splat: Splat) -> Splat:
    """Leave out Gaussians that no renderer shows, and say how many there were."""
    from pop_fast.train.metrics import ALPHA_FLOOR

    kept = splat.params["opacities"].sigmoid() >= ALPHA_FLOOR
    before, after = len(kept), int(kept.sum())
    print(f"opacity >= 1/255: {after:,} of {before:,} Gaussians kept, {before - after:,} left out")
    return replace(splat, params={name: value[kept] for name, value in splat.params.items()})
