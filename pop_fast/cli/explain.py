"""`pop explain`: why a pixel looks as it does, as a table, JSON and a page, and the view as maps."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Annotated, Final, Literal

import tyro

from pop_fast.cli import parse, printable
from pop_fast.cli.options import CaptureArguments, open_with_bars
from pop_fast.errors import PopError
from pop_fast.io.atomic import check_file, check_folder, folder_atomically, write_file, write_json
from pop_fast.train.load_result import check_not_read, load_splat
from pop_ref.constants import PROFILES

if TYPE_CHECKING:
    from pop_fast.data import Capture, View

_EXAMPLES: Final = """
    pop explain out/scene_pop --view 3 --pixel 120,80                     the table
    pop explain out/scene_pop --view 3 --pixel 120,80 --html why.html     and a page with pictures and maps
    pop explain a.ply --capture scene --view IMG_7.jpg --maps maps        the maps alone, one PNG each
    pop explain out/scene_pop --view 3 --pixel 120,80 --diff paper inria  where two profiles or backends differ
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Explain a pixel: what it is blended from, why entries were skipped, what the loss and POP do to them."""

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|PLY")]
    """What to look into."""
    view: Annotated[str, tyro.conf.arg(metavar="INDEX|NAME")]
    """A view of the capture: its place by file name, from 0, or the name itself."""
    pixel: Annotated[str | None, tyro.conf.arg(metavar="X,Y")] = None
    """The pixel: column and row, from 0 at the upper left. Not needed for maps alone."""
    profile: Annotated[str | None, tyro.conf.arg(metavar=f"{{{','.join(PROFILES)}}}")] = None
    """The rasterizer's constants; by default as in training."""
    objective: Literal["run", "pop", "3dgs"] = "run"
    """The loss that is differentiated: the run's own (POP's for a lone file), paper eq. 9, or eq. 2."""
    all: bool = False
    """Print every entry, not only those that matter."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write all numbers to this file."""
    html: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write a page with the picture, the splats' ellipses, the table and the maps."""
    maps: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Also write the view's maps into this new folder, one PNG each."""
    diff: Annotated[tuple[str, str] | None, tyro.conf.arg(metavar="A B")] = None
    """Also compare two profiles or backends (fast, compiled, ref, cuda) on the view and at the pixel."""
    overwrite: bool = False
    """Replace the folder of maps if it exists."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "explain", examples=_EXAMPLES)
    at = None if args.pixel is None else parse_pixel(args.pixel)
    if at is None and (args.maps is None or args.html or args.json or args.diff):
        raise PopError("pixel is not given; say which with --pixel X,Y, or ask for maps alone with --maps DIR")
    for file in (args.json, args.html):
        if file is not None:
            check_file(file)
    if args.maps is not None:
        check_folder(args.maps, args.overwrite)
    return _explain(args, at)


def _explain(args: Args, at: tuple[int, int] | None) -> int:
    from pop_fast.train.environment import reproducible
    from pop_fast.view.explain import explain_pixel, explain_view
    from pop_fast.view.explain.diff import difference
    from pop_fast.view.explain.page import page
    from pop_fast.view.explain.pixel import WIDTH, check_inside, table
    from pop_fast.view.explain.scene import view_maps, with_objective, write_maps

    splat = load_splat(args.splat)
    for file in filter(None, (args.json, args.html)):
        check_not_read(file, splat)
    capture, config = open_with_bars(splat, args)
    view = chosen_view(capture, args.view)
    if at is not None:
        check_inside(view, *at)
    if args.profile is not None:
        config = config.with_overrides(profile=args.profile, near_plane=None, eps2d=None).in_world(capture.world_scale)
    config = with_objective(config, args.objective)
    with reproducible(config.threads):
        scene = explain_view(splat.params, view, config, splat.sh_degree, splat.step)
        parting = None if args.diff is None or at is None else difference(scene, *args.diff, *at, capture.world_scale)
        maps = view_maps(scene) if args.maps or args.html else []
    maps += parting.maps if parting else ()
    if at is not None:
        explanation = explain_pixel(scene, *at)
        print(printable(table(explanation, args.all)))
        if parting:
            print(
                "\n" + "\n".join(part for line in parting.lines for part in wrap(line, WIDTH, subsequent_indent="    "))
            )
        if args.json is not None:
            plain = json.loads(explanation.to_json()) | ({"difference": parting.plain()} if parting else {})
            write_json(args.json, plain, indent=1)
        if args.html is not None:
            text = page(explanation, maps, parting.lines if parting else ())
            write_file(args.html, text.encode("utf-8", "backslashreplace"))
    if args.maps is not None:
        with folder_atomically(args.maps, args.overwrite) as folder:
            write_maps(maps, folder)
        print(printable(f"{len(maps)} maps of {view.name} -> {args.maps}"))
    return 0


def parse_pixel(text: str) -> tuple[int, int]:
    try:
        x, y = (int(word) for word in text.split(","))
    except ValueError:
        raise PopError(f"pixel is {text!r}; give column and row as two whole numbers, --pixel 120,80") from None
    return x, y


def chosen_view(capture: Capture, which: str) -> View:
    named = [view for view in capture.views if which in (view.name, Path(view.name).name, Path(view.name).stem)]
    if len(named) == 1:
        return named[0]
    last = len(capture.views) - 1
    span = f"0 ({capture.views[0].name}) to {last} ({capture.views[-1].name})"
    try:
        place = int(which)
    except ValueError:
        what = f"names {len(named)} views" if named else "is no view"
        raise PopError(f"view {which!r} {what} of {capture.name}; give a file name, or a place from {span}") from None
    if not 0 <= place <= last:
        raise PopError(f"view is {which}; {capture.name} has views {span}")
    return capture.views[place]
