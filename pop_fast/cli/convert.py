"""`pop convert`: a splat's file in another format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import tyro

from pop_fast.cli.arguments import parse
from pop_fast.cli.export import check_file
from pop_fast.cli.limits import FormatName, LimitOptions, Shown, limited
from pop_fast.errors import PopError

_EXAMPLES: Final = """
    pop convert scene.ply scene.sog
    pop convert scene.spz scene.ply
    pop convert scene.ply scene.glb --to gltf-spz
    pop convert scene.ply small.spz --max-gaussians 100000
"""


@dataclass(frozen=True, kw_only=True)
class Args(LimitOptions):
    """Turn a splat's file into another format; names say which. docs/FORMATS.md says what each keeps."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="IN")]
    """A .ply, .compressed.ply, .spz, .sog, .splat or .glb."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """The file to write, in the same frame."""
    to: FormatName | None = None
    """The format, where the name does not say it."""
    overwrite: bool = False
    """Replace the file."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "convert", examples=_EXAMPLES)
    args.check()
    if args.score not in ("auto", "visibility"):
        raise PopError(f"--score {args.score} needs the training views; 'pop export RESULT' knows them")
    from pop_fast.io.formats import encoded, load_splat_file, named_format, save_as
    from pop_fast.io.ply import frame_of
    from pop_fast.train.config import TrainConfig

    if args.to == "html" or args.out.suffix.lower() in (".html", ".htm"):
        raise PopError(
            f"{args.out}: a page starts at a training camera; 'pop export {args.source} --to html' writes it"
        )
    name = named_format(args.out, args.to)
    check_file(args.out, args.source, args.overwrite)
    params, antialiased = load_splat_file(args.source)
    shown = Shown(params=params, sh_degree=3, config=TrainConfig(), world_transform=None, capture=None)
    kept, said = limited(shown, args, lambda rows: len(encoded(name, rows, antialiased)))
    for line in said:
        print(line)
    frame = frame_of(args.source) if args.source.suffix.lower() == ".ply" else None
    size = save_as(args.out, name, kept, antialiased, frame)
    print(f"{len(kept['means']):,} Gaussians, {size / 2**20:.1f} MiB -> {args.out}")
    return 0
