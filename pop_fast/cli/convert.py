"""`pop convert`: a splat's file in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import tyro

from pop_fast.cli import parse
from pop_fast.cli.export import HTML, check_file, file_format, note_lost_frame, page_output
from pop_fast.cli.options import FormatName, LimitOptions, Output, Shown, limited
from pop_fast.errors import PopError
from pop_fast.train.config import TrainConfig
from pop_fast.train.load_result import CaptureOptions, Splat, drawn_as, drawn_in_frame

if TYPE_CHECKING:
    from pop_fast.io.formats import Stored

_EXAMPLES: Final = """
    pop convert scene.ply scene.sog
    pop convert scene.spz scene.ply
    pop convert scene_sog scene.spz --to spz-4
    pop convert scene.ply scene.html
    pop convert scene.ply small.spz --max-gaussians 100000
"""
# colour degree to draw
_MOST_BANDS: Final = 3


@dataclass(frozen=True, kw_only=True)
class Args(LimitOptions):
    """Turn a splat's file into another format; names say which. docs/FORMATS.md says what each keeps."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """A .ply, .compressed.ply, .spz, .sog, .splat, .glb or .ksplat, or the folder of an unbundled SOG."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write, in the same frame."""
    to: FormatName | None = None
    """The format, if the name does not show it; "spz" is its version 3, and "spz-4" the latest."""
    overwrite: bool = False
    """Replace the file."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "convert", examples=_EXAMPLES)
    args.check()
    needs_views = {
        f"--score {args.score}": args.score not in ("auto", "visibility"),
        "--final-prune": args.final_prune is not None,
        "--without-floaters": args.without_floaters,
    }
    for option, asked in needs_views.items():
        if asked:
            raise PopError(f"{option} needs the training views; 'pop export {args.source} --capture DIR' reads them")
    from pop_fast.io.formats import load_splat_file

    name = file_format(args.out, args.to)
    check_file(args.out, args.source, args.overwrite)
    stored = load_splat_file(args.source)
    note_lost_frame(args.out, name, stored.frame)
    config = drawn_as(TrainConfig(antialiased=stored.antialiased), stored.frame, args.source)
    splat = Splat(path=args.source, params=stored.params, config=config, frame=stored.frame)
    config = drawn_in_frame(splat, CaptureOptions())
    output = _output(args, name, stored, config)
    move = _training_frame(args.source, stored) if args.crop is not None else None
    shown = Shown(params=stored.params, sh_degree=_MOST_BANDS, config=config, world_transform=move, photographed=None)
    limited(shown, args, output).write(args.out, output)
    return 0


def _output(args: Args, name: str, stored: Stored, config: TrainConfig) -> Output:
    if name == HTML:
        return page_output((), config, _MOST_BANDS, args.source)
    return Output(name, stored.antialiased, stored.frame)


def _training_frame(source: Path, stored: Stored) -> np.ndarray | None:
    """Return the training frame from the capture's; None where the splat is in the capture's own frame."""
    if stored.frame is None or stored.frame.name == "capture":
        return None
    if stored.frame.transform is None:
        raise PopError(
            f"{source}: is in a training frame, and --crop is meant in the capture's; pop export it with --capture DIR"
        )
    return np.array(stored.frame.transform)
