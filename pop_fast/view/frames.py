"""What `pop render` and `pop export` draw: cameras of views and paths, their frames, and where these are written."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from pop_fast.data import Capture
from pop_fast.errors import PopError
from pop_fast.io.heartbeat import Heartbeat
from pop_fast.io.images import write_png
from pop_fast.io.names import inside
from pop_fast.train.config import TrainConfig
from pop_fast.train.environment import reproducible
from pop_fast.train.gpu_proxy import renderer
from pop_fast.train.load_result import Splat
from pop_fast.train.views import ViewTensors, render_view
from pop_fast.view.paths import PATHS, VideoFile, camera_path


def check_one_size(video: VideoFile, views: Sequence[ViewTensors]) -> None:
    """Check that all views make frames of one size.

    Raises:
        PopError: they do not.
    """
    # in pairs of pixels, as an odd last row or column is left out of a video
    sizes = {tuple(side // 2 for side in view.photo.shape[:2]): view for view in reversed(views)}
    if len(sizes) > 1:
        some = list(sizes.values())[:2]
        listed = ", ".join(f"{view.name} is {view.photo.shape[1]} x {view.photo.shape[0]} px" for view in some)
        raise PopError(
            f"{video.path}: the views have {len(sizes)} sizes ({listed}) and a video has one; "
            "write pictures with --out DIR, or film a path with --path orbit"
        )


def planned_views(capture: Capture, config: TrainConfig, path: str, frames: int) -> list[ViewTensors]:
    """Choose the cameras: the held-out views, or a path with the size and lens of the first training view.

    Args:
        capture: in the frame of the splat.
        config: `test_every` is read.
        path: "views", the name of a path, or a file that `pop view` recorded, whose angles of view are used.
        frames: cameras of a path.

    Raises:
        PopError: there is nothing to render, or too little to make the path of, or the file is no path.
    """
    if path == "views":
        views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
        if not views:
            raise PopError(f"{capture.name}: holds no view out; give --test-every 8, or --path orbit")
        return views
    if frames < 1:
        raise PopError(f"frames is {frames}; give --frames 1 or more")
    train = capture.train_views(config.test_every)
    if path not in PATHS:
        return _recorded(capture, Path(path), frames)
    needed = 2 if path == "interpolate" else 1
    if len(train) < needed:
        raise PopError(
            f"{capture.name}: --path {path} needs {needed} or more training views and there are {len(train)}; "
            f"hold fewer out with --test-every 0{', or take --path orbit' if train else ''}"
        )
    lens = train[0]
    blank = torch.zeros((lens.height, lens.width, 3), dtype=torch.uint8)
    K = torch.from_numpy(lens.K).float()[None]
    viewmats = camera_path(path, np.stack([view.viewmat for view in train]), frames)
    return [
        ViewTensors(f"{path}_{i:04d}", blank, None, torch.from_numpy(viewmat).float()[None], K)
        for i, viewmat in enumerate(viewmats)
    ]


def _recorded(capture: Capture, path: Path, frames: int) -> list[ViewTensors]:
    """Make the cameras of a recorded path, in the size of the first photograph."""
    from pop_fast.view.live import ViewState, read_path

    lens = capture.views[0]
    along = read_path(path).along(frames, capture.world_transform)
    states = [ViewState(camera.viewmat, camera.fov_y, lens.width, lens.height) for camera in along]
    return [replace(state.camera(), name=f"path_{i:04d}") for i, state in enumerate(states)]


@torch.no_grad()
def rendered(
    splat: Splat, config: TrainConfig, views: Sequence[ViewTensors], as_measured: bool = False
) -> Iterator[np.ndarray]:
    """Render views one by one. uint8 [H, W, 3] each

    Args:
        splat: what to render.
        config: how.
        views: the cameras.
        as_measured: count Gaussians per pixel, as measurements do, which rounds sums otherwise: only then are the bytes
            always those that training has left.
    """
    backend, note = renderer(config.backend)
    if note:
        print(f"note: {note}", file=sys.stderr)
    with reproducible(config.threads), Heartbeat() as beat:
        for done, view in enumerate(tqdm(views, desc="rendering", unit="view", disable=None, leave=False)):
            beat.say(f"rendering: {done:,} of {len(views):,}")
            image = render_view(backend, splat.params, view, config, splat.sh_degree, counts=as_measured).image
            yield (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def write_pictures(frames: Iterator[np.ndarray], files: Sequence[Path], folder: Path) -> Iterator[np.ndarray]:
    """Write each frame as PNG under its name in the folder, and hand it on."""
    for frame, file in zip(frames, files, strict=True):
        write_png(inside(folder, file), frame)
        yield frame


def write_video(frames: Iterator[np.ndarray], video: VideoFile | None) -> int:
    """Write frames to a video, or just take them where `video` is None; returns how many there were."""
    count = 0
    with video or nullcontext():
        for frame in frames:
            if video is not None:
                video.add(frame)
            count += 1
    return count
