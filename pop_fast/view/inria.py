"""The folder that 3DGS's own trainer leaves, which SIBR, metrics.py and most papers' scripts read."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from pop_fast.data import Capture, View, to_capture_frame
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.images import write_png
from pop_fast.io.ply import Frame, save_ply
from pop_fast.train.load_result import Splat, paths_read
from pop_fast.train.views import ViewTensors
from pop_fast.view.frames import rendered
from pop_ref.settings import Recipe

_BY: Final = "exported_by='pop export'"
_FILES: Final = re.compile(
    r"cfg_args|cameras\.json|point_cloud/iteration_\d+/point_cloud\.ply|test/ours_\d+/(renders|gt)/\d{5,}\.png"
)


def write_inria_folder(splat: Splat, capture: Capture, out: Path, overwrite: bool) -> None:
    """Write a splat and its capture in Inria's layout, whole or not at all, in the capture's own world frame.

        cfg_args  cameras.json  point_cloud/iteration_N/point_cloud.ply
        test/ours_N/renders/00000.png  test/ours_N/gt/00000.png

    Args:
        splat: what to write, in the frame of `capture`.
        capture: its cameras and photographs.
        out: the folder to make.
        overwrite: replace a folder that an earlier export wrote, if nothing else is in it.

    Raises:
        PopError: `out` is there and may not be replaced, or cannot be written.
    """
    transform = capture.world_transform
    steps = Recipe.max_steps if splat.step is None else splat.step + 1
    held_out = capture.test_views(splat.config.test_every)
    keeps = paths_read(splat, Path(splat.config.data), capture)
    with folder_atomically(out, overwrite, keeps=keeps, recognise=exported_to(out)) as folder:
        params = to_capture_frame(splat.params, transform)
        path = folder / "point_cloud" / f"iteration_{steps}" / "point_cloud.ply"
        save_ply(path, params, splat.config.antialiased, frame=Frame("capture"))
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
        "sh_degree": splat.sh_degree,
        "source_path": splat.config.data,
        "white_background": splat.config.background == (1.0, 1.0, 1.0),
    }
    # last comes a setting that no script asks for: it tells our exports from folders that took days to train
    return f"Namespace({', '.join(f'{name}={value!r}' for name, value in settings.items())}, {_BY})"
