"""What `pop render` and `pop export` draw: cameras of views and paths, their frames, and the files of these.

Whatever a capture calls its views, their pictures stay in one folder, one each. `write_inria_folder` writes the folder
that 3DGS's own trainer leaves, which SIBR, metrics.py and most papers' scripts read.
"""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from itertools import takewhile
from pathlib import Path, PureWindowsPath
from typing import Any, Final

import numpy as np
import torch
from tqdm import tqdm

from pop_fast.data import Capture, View, to_capture_frame
from pop_fast.errors import PopError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.heartbeat import Heartbeat
from pop_fast.io.image_header import HEIF_SUFFIXES
from pop_fast.io.images import IMAGE_SUFFIXES, write_png
from pop_fast.io.ply import Frame, save_ply
from pop_fast.train.config import TrainConfig
from pop_fast.train.engines import renderer
from pop_fast.train.environment import reproducible
from pop_fast.train.load_result import Splat, paths_read
from pop_fast.train.views import ViewTensors, render_view
from pop_fast.view.paths import PATHS, VideoFile, camera_path
from pop_ref.settings import Recipe

_PICTURES = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def picture_names(views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Give every view its own file name, relative to the folder that the pictures go to.

    "images/a.jpg" becomes images/a.png. A suffix that is no image's is part of the name: "cam.00" becomes cam.00.png.
    What leads out of the folder is dropped: "..", and of absolute names the root and the folders that all of them
    share. Views that differ only in their suffix keep it (x.jpg.png, x.png.png), and what still meets is numbered.
    Names that differ only in case count as the same, because some file systems hold them to be.

    Example:
        >>> [path.as_posix() for path in picture_names(["/data/a/0.jpg", "/data/b/0.jpg", "../c/1.png"])]
        ['a/0.png', 'b/0.png', 'c/1.png']
    """
    whole = [Path(*parts) for parts in _inner_parts(views)]
    plain = [path.with_name((path.stem if path.suffix.lower() in _PICTURES else path.name) + suffix) for path in whole]
    wanted = Counter(map(_key, plain))
    taken: set[str] = set()
    names: list[Path] = []
    for path, short in zip(whole, plain, strict=True):
        first = short if wanted[_key(short)] == 1 else path.with_name(path.name + suffix)
        name, number = first, 2
        while _key(name) in taken:
            name, number = first.with_stem(f"{first.stem}_{number}"), number + 1
        taken.add(_key(name))
        names.append(name)
    return names


def inside(folder: Path, name: Path) -> Path:
    """Join a relative name to a folder; a PopError refuses a file that would lie outside it."""
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise PopError(f"{name}: leads out of {folder}; give it a name without '..' and without a root")
    return path


def _inner_parts(names: Sequence[str]) -> list[tuple[str, ...]]:
    # Windows' rules know both slashes and drives, so lists that were written there are understood everywhere
    paths = [PureWindowsPath(name) for name in names]
    rooted = [path.parts[1:-1] for path in paths if path.anchor]
    shared = 1 + sum(1 for _ in takewhile(lambda parts: len(set(parts)) == 1, zip(*rooted, strict=False)))
    parts = [path.parts[shared:] if path.anchor else path.parts for path in paths]
    return [tuple(part for part in some if part != "..") or ("view",) for some in parts]


def _key(path: Path) -> str:
    return path.as_posix().casefold()


def check_one_size(video: VideoFile, views: Sequence[ViewTensors]) -> None:
    """Refuse views that do not all make frames of one size."""
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
    """
    if path == "views":
        views = [ViewTensors.of(view) for view in capture.test_views(config.test_every)]
        if not views:
            instead = "--path orbit" if capture.has_own_split else "--test-every 8, or --path orbit"
            raise PopError(f"{capture.name}: no view is held out; give {instead}")
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

    With `as_measured` Gaussians per pixel are counted, as measurements do, which rounds sums otherwise: only then are
    the bytes always those that training has left.
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


_BY: Final = "exported_by='pop export'"
_FILES: Final = re.compile(
    r"cfg_args|cameras\.json|point_cloud/iteration_\d+/point_cloud\.ply|test/ours_\d+/(renders|gt)/\d{5,}\.png"
)


def write_inria_folder(splat: Splat, capture: Capture, out: Path, overwrite: bool) -> None:
    """Write a splat and its capture in Inria's layout, whole or not at all, in the capture's own world frame.

        cfg_args  cameras.json  point_cloud/iteration_N/point_cloud.ply
        test/ours_N/renders/00000.png  test/ours_N/gt/00000.png

    The splat is in the frame of `capture`. With `overwrite`, a folder with nothing but an earlier export is replaced.
    """
    transform = capture.world_transform
    steps = Recipe.max_steps if splat.step is None else splat.step + 1
    held_out = capture.test_views(splat.config.test_every)
    keeps = paths_read(splat, Path(splat.config.data), capture)
    with folder_atomically(out, overwrite, keeps=keeps, recognise=exported_to(out)) as folder:
        params = to_capture_frame(splat.params, transform)
        path = folder / "point_cloud" / f"iteration_{steps}" / "point_cloud.ply"
        frame = replace(Frame.of_training(transform, splat.config.drawn), name="capture")
        save_ply(path, params, splat.config.antialiased, frame=frame)
        cameras = [_camera(i, view, transform, capture.world_scale) for i, view in enumerate(capture.views)]
        (folder / "cameras.json").write_text(json.dumps(cameras), encoding="utf-8")
        (folder / "cfg_args").write_text(_cfg_args(splat, out), encoding="utf-8")
        frames = rendered(splat, splat.config, [ViewTensors.of(view) for view in held_out], as_measured=True)
        for i, (view, frame) in enumerate(zip(held_out, frames, strict=True)):
            write_png(folder / "test" / f"ours_{steps}" / "renders" / f"{i:05d}.png", frame)
            write_png(folder / "test" / f"ours_{steps}" / "gt" / f"{i:05d}.png", view.image)


def exported_to(folder: Path) -> Callable[[Path], bool]:
    """Tell which files of a folder an earlier export wrote; none where another trainer left the folder."""
    try:
        ours = _BY in (folder / "cfg_args").read_text(encoding="utf-8")
    except (OSError, ValueError):
        ours = False
    return lambda file: ours and _FILES.fullmatch(file.as_posix()) is not None


def _camera(index: int, view: View, transform: np.ndarray, scale: float) -> dict[str, Any]:
    """Describe a camera of the capture's own frame: position, camera-to-world rotation, focal lengths."""
    rotation = (view.viewmat[:3, :3] @ (transform[:3, :3] / scale)).T
    position = (np.linalg.inv(transform) @ np.append(view.camera_center, 1.0))[:3]
    return {
        "id": index,
        "img_name": Path(view.name).stem,
        "width": view.width,
        "height": view.height,
        "position": position.tolist(),
        "rotation": rotation.tolist(),
        "fy": float(view.K[1, 1]),
        "fx": float(view.K[0, 0]),
    }


def _cfg_args(splat: Splat, out: Path) -> str:
    """Write the settings as Inria's scripts read them back: the text of an argparse Namespace."""
    settings = {
        "data_device": "cpu",
        "eval": splat.config.test_every > 0,
        "images": "images",
        "model_path": str(out),
        "resolution": splat.config.factor,
        # of the PLY's columns, which Inria's loader compares with this, whatever degree was reached
        "sh_degree": 3,
        "source_path": splat.config.data,
        "white_background": splat.config.background == (1.0, 1.0, 1.0),
    }
    # last comes a setting that no script asks for: it tells our exports from folders that took days to train
    return f"Namespace({', '.join(f'{name}={value!r}' for name, value in settings.items())}, {_BY})"
