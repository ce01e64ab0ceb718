"""`pop render`: held-out views as pictures, or a camera path as pictures or a video.

Next to the pictures is renders.json: what was rendered, and which file shows which view. It is also how a folder of
pictures is known as this command's own, so that --overwrite replaces nothing else.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import tyro

from pop_fast.cli import parse, printable
from pop_fast.cli.options import CaptureArguments, open_with_bars
from pop_fast.errors import PopError
from pop_fast.io.atomic import check_file, check_folder, folder_atomically, write_json
from pop_fast.train.load_result import load_splat, paths_read

if TYPE_CHECKING:
    from pop_fast.view.paths import VideoFile

_INDEX: Final = "renders.json"
# of a path, and of a video a second
_FRAMES: Final = 120
_MOST_FRAMES: Final = 1_000_000
_FPS: Final = 30.0
_EXAMPLES: Final = """
    pop render out/scene_pop --out views                     the held-out views, one PNG each
    pop render out/scene_pop --path orbit --video orbit.webm  a video around the scene
    pop render out/scene_pop --path garden_path.json --video walk.webm   a path recorded in 'pop view'
    pop render a.ply --capture scene --path interpolate --frames 240 --out frames
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureArguments):
    """Render the held-out views, or a camera path through the capture."""

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|FILE")]
    """What to render."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write one PNG a view into this new folder, and renders.json, which lists them."""
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a video: .webm, .avi, or .mp4 where OpenCV can write H.264."""
    path: Annotated[str, tyro.conf.arg(metavar="{views,orbit,ellipse,interpolate}|FILE")] = "views"
    """"views" are held out; three are made from the training cameras; a file is a path that 'pop view' recorded."""
    frames: Annotated[int | None, tyro.conf.arg(help_behavior_hint="(default: 120)")] = None
    """Number of frames of a path."""
    fps: Annotated[float | None, tyro.conf.arg(help_behavior_hint="(default: 30)")] = None
    """Frames per second of a video."""
    overwrite: bool = False
    """Replace the video, and a folder that holds only an earlier render."""


def run(argv: Sequence[str]) -> int:
    args = parse(Args, argv, "render", examples=_EXAMPLES)
    if args.out is None and args.video is None:
        raise PopError("nothing to write; give --out DIR for pictures, --video FILE for a video, or both")
    # all that can be refused without a splat, before anything of torch is imported
    check_path(args.path)
    if args.frames is not None and args.path == "views":
        raise PopError(f"--frames {args.frames} is of a path, and every held-out view is drawn; give --path orbit")
    if args.fps is not None and args.video is None:
        raise PopError(f"--fps {args.fps:g} is of a video; give --video FILE")
    if args.frames is not None and not 1 <= args.frames <= _MOST_FRAMES:
        raise PopError(f"frames is {args.frames}; give --frames 1 or more, and at most {_MOST_FRAMES:,}")
    if args.out is not None:
        keeps = [args.splat] if args.capture is None else [args.splat, args.capture]
        check_folder(args.out, args.overwrite, keeps=keeps, recognise=listed_in(args.out))
    return _render(args, planned_video(args))


def _render(args: Args, video: VideoFile | None) -> int:
    from pop_fast.view.frames import check_one_size, picture_names, planned_views, rendered, write_pictures, write_video

    splat = load_splat(args.splat)
    capture, config = open_with_bars(splat, args)
    views = planned_views(capture, config, args.path, _FRAMES if args.frames is None else args.frames)
    if video is not None:
        check_one_size(video, views)
    frames = rendered(splat, config, views, as_measured=args.path == "views")
    if args.out is None:
        written = write_video(frames, video)
    else:
        keeps = paths_read(splat, Path(config.data), capture)
        with folder_atomically(args.out, args.overwrite, keeps=keeps, recognise=listed_in(args.out)) as folder:
            files = picture_names([view.name for view in views])
            written = write_video(write_pictures(frames, files, folder), video)
            listing = [{"view": view.name, "file": file.as_posix()} for view, file in zip(views, files, strict=True)]
            index = {"splat": str(splat.path), "capture": capture.name, "path": args.path, "renders": listing}
            write_json(folder / _INDEX, index)
    targets = " and ".join(str(target) for target in (args.out, args.video) if target is not None)
    print(printable(f"{written} view{'' if written == 1 else 's'} of {capture.name} -> {targets}"))
    return 0


def check_path(path: str) -> None:
    from pop_fast.view.paths import PATHS

    if path in ("views", *PATHS):
        return
    if not Path(path).is_file():
        names = ", ".join(("views", *PATHS))
        raise PopError(
            f"path is '{path}', which is not a file; give --path one of {names}, or a file that 'pop view' saved"
        )
    from pop_fast.view.live import read_path

    read_path(Path(path))


def planned_video(args: Args) -> VideoFile | None:
    """Check the video that was asked for before the long work begins."""
    if args.video is None:
        return None
    from pop_fast.view.paths import VideoFile

    video = VideoFile(args.video, _FPS if args.fps is None else args.fps)
    if args.out is not None and args.video.resolve().is_relative_to(args.out.resolve()):
        raise PopError(
            f"{args.video}: lies in --out {args.out}, which holds pictures only; give --video another folder"
        )
    if args.video.exists() and not args.overwrite:
        raise PopError(f"{args.video}: exists; pass --overwrite or another --video")
    check_file(args.video)
    return video


def listed_in(folder: Path) -> Callable[[Path], bool]:
    """Tell which files of a folder an earlier render wrote: those that its renders.json lists, and that itself."""
    try:
        index = json.loads((folder / _INDEX).read_text(encoding="utf-8"))
        files = {_INDEX, *(str(entry["file"]) for entry in index["renders"])}
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        files = set()  # not there, or not this command's: then nothing in the folder is known to be
    return lambda file: file.as_posix() in files
