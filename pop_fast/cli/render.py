"""`pop render`: held-out views as pictures, or a camera path as pictures or a video."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

from pop_fast.cli.arguments import parse
from pop_fast.cli.splat import CaptureOptions, Splat, load_splat, open_capture
from pop_fast.data import Capture
from pop_fast.errors import PopError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.images import write_png
from pop_fast.paths import VideoFile, camera_path
from pop_fast.train.config import TrainConfig
from pop_fast.train.environment import reproducible
from pop_fast.train.on_device import renderer
from pop_fast.train.views import ViewTensors, render_view

_EXAMPLES: Final = """
    pop render out/scene_pop --out views                     the held-out views, one PNG each
    pop render out/scene_pop --path orbit --video orbit.mp4  a video around the scene
    pop render a.ply --capture scene --path interpolate --frames 240 --out frames
"""


@dataclass(frozen=True, kw_only=True)
class Args(CaptureOptions):
    """Render the held-out views, or a camera path through the capture."""

    splat: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULT|CKPT|PLY")]
    """What to render."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Write one PNG a view into this new folder."""
    video: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Write a video: .mp4, .webm or .avi."""
    path: Literal["views", "orbit", "ellipse", "interpolate"] = "views"
    """"views" are the held-out views; the others are paths made from the training cameras."""
    frames: int = 120
    """Frames of a path."""
    fps: float = 30.0
    """Frames a second of a video."""
    overwrite: bool = False
    """Replace what is already there."""


def run(argv: Sequence[str]) -> int:
    """Run the subcommand."""
    args = parse(Args, argv, "render", examples=_EXAMPLES)
    if args.out is None and args.video is None:
        raise PopError("nothing to write; give --out DIR for pictures, --video FILE for a video, or both")
    if args.video is not None and args.video.exists() and not args.overwrite:
        raise PopError(f"{args.video}: exists; pass --overwrite or another --video")
    splat = load_splat(args.splat)
    capture, config = open_capture(splat, args)
    views = planned_views(capture, config, args.path, args.frames)
    frames = rendered(splat, config, views)
    if args.out is None:
        written = write_video(frames, args.video, args.fps)
    else:
        with folder_atomically(args.out, args.overwrite) as folder:
            pictures = write_pictures(frames, views, folder)
            written = write_video(pictures, args.video, args.fps)
    targets = " and ".join(str(target) for target in (args.out, args.video) if target is not None)
    print(f"{written} views of {capture.name} -> {targets}")
    return 0


def planned_views(capture: Capture, config: TrainConfig, path: str, frames: int) -> list[ViewTensors]:
    """Choose the cameras: the held-out views, or a path with the size and lens of the first training view.

    Raises:
        PopError: there is nothing to render.
    """
    if path == "views":
        views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
        if not views:
            raise PopError(f"{capture.name}: holds no view out; give --test-every 8, or --path orbit")
        return views
    train = capture.train_views(config.test_every)
    lens = train[0]
    blank = torch.zeros((lens.height, lens.width, 3), dtype=torch.uint8)
    K = torch.from_numpy(lens.K).float()[None]
    viewmats = camera_path(path, np.stack([view.viewmat for view in train]), frames)
    return [
        ViewTensors(f"{path}_{i:04d}", blank, None, torch.from_numpy(viewmat).float()[None], K)
        for i, viewmat in enumerate(viewmats)
    ]


@torch.no_grad()
def rendered(splat: Splat, config: TrainConfig, views: Sequence[ViewTensors]) -> Iterator[np.ndarray]:
    """Render views one by one. uint8 [H, W, 3] each"""
    backend, note = renderer(config.backend)
    if note:
        print(f"note: {note}", file=sys.stderr)
    with reproducible(config.threads):
        for view in tqdm(views, desc="rendering", unit="view", disable=None, leave=False):
            image = render_view(backend, splat.params, view, config, splat.sh_degree).image
            yield (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def write_pictures(frames: Iterator[np.ndarray], views: Sequence[ViewTensors], folder: Path) -> Iterator[np.ndarray]:
    """Write each frame as PNG under its view's name, and hand it on."""
    for frame, view in zip(frames, views, strict=True):
        write_png(folder / Path(view.name).with_suffix(".png"), frame)
        yield frame


def write_video(frames: Iterator[np.ndarray], path: Path | None, fps: float) -> int:
    """Write frames to a video, or just take them where `path` is None; returns how many there were."""
    count = 0
    if path is None:
        for _ in frames:
            count += 1
        return count
    with VideoFile(path, fps) as video:
        for frame in frames:
            video.add(frame)
            count += 1
    return count
