"""The files that the fuzzer starts from: one small sound file of each kind that the program reads.

They are kept in `corpus/`, so that a number names the same input everywhere; `python -m benchmarks.faults.corpus` makes
them anew, which changes what every number means. `corpus/regressions` holds inputs that once broke something, each in
a folder named after its reader; they are read as they are, before anything is mutated.
"""

from __future__ import annotations

import json
import math
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import torch

from pop_fast.data.load import load_capture
from pop_fast.io.formats import FORMATS, encoded
from pop_fast.io.ply import save_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.load_result import RECORD, CaptureRecord, record_text

HERE = Path(__file__).resolve().parent / "corpus"
WIDTH, HEIGHT, FOCAL, VIEWS, POINTS = 24, 16, 20.0, 3, 12


def make(folder: Path) -> None:
    """Write every file but the regressions."""
    capture, text, transforms = (folder / name for name in ("colmap", "colmap_text", "transforms"))
    for place in (capture, text, transforms):
        shutil.rmtree(place, ignore_errors=True)
        (place / "images").mkdir(parents=True)
        for view in range(VIEWS):
            cv2.imwrite(str(place / "images" / f"{view}.png"), _photograph(view))
    (capture / "sparse" / "0").mkdir(parents=True)
    (text / "sparse" / "0").mkdir(parents=True)
    _write_binary(capture / "sparse" / "0")
    _write_text(text / "sparse" / "0")
    (transforms / "transforms.json").write_text(json.dumps(_transforms(), indent=1))
    photos = folder / "photos"
    photos.mkdir(exist_ok=True)
    for suffix in ("png", "jpg", "webp", "bmp", "tif"):
        cv2.imwrite(str(photos / f"photo.{suffix}"), _photograph(0))
    _write_result(folder / "result", capture)
    _write_splats(folder / "splats")


def _photograph(view: int) -> np.ndarray:
    ys, xs = np.mgrid[:HEIGHT, :WIDTH]
    waves = [np.sin(xs / (2.0 + channel) + view) * np.cos(ys / 3.0 + channel) for channel in range(3)]
    return (127.5 + 120.0 * np.stack(waves, axis=-1)).astype(np.uint8)


def _points() -> list[tuple[float, float, float]]:
    return [(math.sin(2.0 * k), math.cos(3.0 * k) * 0.5, 4.0 + 0.25 * k) for k in range(POINTS)]


def _write_binary(model: Path) -> None:
    camera = struct.pack("<QiiQQdddd", 1, 1, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (model / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", VIEWS)
    for view in range(VIEWS):
        pose = (1.0, 0.0, 0.0, 0.0, 0.1 * view, 0.0, 0.0)
        images += struct.pack("<i7di", view + 1, *pose, 1) + f"{view}.png\0".encode() + struct.pack("<Q", 1)
        images += struct.pack("<ddq", 3.0, 4.0, 1)
    (model / "images.bin").write_bytes(images)
    points = struct.pack("<Q", POINTS)
    for number, xyz in enumerate(_points(), 1):
        points += struct.pack("<Q3d3BdQii", number, *xyz, 200, 100, 50, 0.5, 1, 1, 0)
    (model / "points3D.bin").write_bytes(points)


def _write_text(model: Path) -> None:
    (model / "cameras.txt").write_text(
        f"# cameras\n1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    images = [f"{view + 1} 1 0 0 0 {0.1 * view} 0 0 1 {view}.png\n3.0 4.0 1\n" for view in range(VIEWS)]
    (model / "images.txt").write_text("".join(images))
    points = [f"{number} {x} {y} {z} 200 100 50 0.5 1 0\n" for number, (x, y, z) in enumerate(_points(), 1)]
    (model / "points3D.txt").write_text("".join(points))


def _transforms() -> dict[str, object]:
    def frame(view: int) -> dict[str, object]:
        pose = [[1, 0, 0, 0.1 * view], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        return {"file_path": f"images/{view}.png", "transform_matrix": pose}

    size = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    return {**size, "camera_model": "OPENCV", "k1": 0.0, "frames": [frame(view) for view in range(VIEWS)]}


def _write_result(folder: Path, capture: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    settings = {"test_every": 3, "threads": 1, "progress": False, "backend": "fast", "ssim_padding": "same"}
    config = TrainConfig.of(preset="quick", max_steps=4, log_every=1, result_dir=str(folder), **settings)
    TrainingRun(config, load_capture(str(capture))).run()
    for name in ("viewer.html", "renders"):
        shutil.rmtree(folder / name, ignore_errors=True)
    record = CaptureRecord(
        images="images", missing="error", masks=True, source="auto", world_transform=np.eye(4).tolist()
    )
    (folder / RECORD).write_text(record_text(record))
    # where it was made is nobody's business
    path = folder / "cfg.json"
    path.write_text(path.read_text().replace(str(folder), "result"))


def _write_splats(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    random = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    params = {key: 0.5 * torch.randn((3, *shape), generator=random) for key, shape in shapes.items()}
    save_ply(folder / "splat.ply", params)
    for name, format in FORMATS.items():
        if name != "ply":
            (folder / f"{name}{format.suffix}").write_bytes(encoded(name, params))


if __name__ == "__main__":
    make(HERE)
