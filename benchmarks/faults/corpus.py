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
import zipfile
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
    with zipfile.ZipFile(folder / "sog.sog") as archive:
        archive.extractall(folder / "sog")
    for level in range(3):
        (folder / f"level_{level}.ksplat").write_bytes(ksplat_of(params, level))


def ksplat_of(params: dict[str, torch.Tensor], level: int, degree: int = 2, full: int = 1) -> bytes:
    """Write KSPLAT by its description: two sections, the first with one Gaussian a bucket, the second with the rest.

    Args:
        params: raw parameters of two Gaussians or more.
        level: of compression, 0 to 2.
        degree: of the colours.
        full: buckets of the first section that are called full; the other one has its length written.
    """
    n = len(params["means"])
    parts = [range(2), range(2, n)]
    capacity = [1, n]
    sections = [
        _ksplat_section(params, list(rows), level, degree, capacity[k], full if k == 0 else 0)
        for k, rows in enumerate(parts)
    ]
    header = struct.pack("<BBHIIIIHH3fff", 0, 1, 0, 2, 2, n, n, level, 0, 0.0, 0.0, 0.0, -2.0, 2.0)
    heads = b"".join(head.ljust(1024, b"\0") for head, _ in sections)
    return header.ljust(4096, b"\0") + heads + b"".join(body for _, body in sections)


def _ksplat_section(
    params: dict[str, torch.Tensor], rows: list[int], level: int, degree: int, capacity: int, full: int
) -> tuple[bytes, bytes]:
    """Return the header and the body of a section, whose Gaussians fill buckets of a capacity one after the other."""
    extent, steps = 5.0, 32767
    raw = {name: value[rows].double().numpy() for name, value in params.items()}
    buckets = [list(range(k, min(k + capacity, len(rows)))) for k in range(0, len(rows), capacity)] if level else []
    full = full if level else 0
    body = b"".join(struct.pack("<I", len(bucket)) for bucket in buckets[full:])
    # a bucket's centre is off its Gaussians, within half of the extent
    centres = [raw["means"][bucket].mean(axis=0) + 0.25 for bucket in buckets]
    body += b"".join(struct.pack("<3f", *centre) for centre in centres)
    for k in range(len(rows)):
        centre = raw["means"][k]
        if level:
            centre = np.rint((centre - centres[k // capacity]) / (0.5 * extent) * steps) + steps
        quat = raw["quats"][k] / np.linalg.norm(raw["quats"][k])
        body += centre.astype("<u2" if level else "<f4").tobytes()
        body += np.concatenate([np.exp(raw["scales"][k]), quat]).astype("<f2" if level else "<f4").tobytes()
        rgba = [*(0.5 + 0.28209479177387814 * raw["sh0"][k, 0]), 1.0 / (1.0 + math.exp(-raw["opacities"][k]))]
        body += np.clip(np.rint(255.0 * np.array(rgba)), 0, 255).astype(np.uint8).tobytes()
        bands = [raw["shN"][k, d * d - 1 : (d + 1) ** 2 - 1].T.ravel() for d in range(1, degree + 1)]
        rest = np.concatenate([np.zeros(0), *bands])
        stored = np.rint((rest + 2.0) / 4.0 * 255.0).clip(0, 255).astype(np.uint8) if level == 2 else rest
        body += stored.astype(("<f4", "<f2", "u1")[level]).tobytes()
    n, partial = len(rows), len(buckets) - full
    fields = (n, n, capacity, len(buckets), extent, 12) if level else (n, n, 0, 0, 0.0, 0)
    return struct.pack("<IIIIfHHIIIIH", *fields, 0, steps if level else 0, len(body), full, partial, degree), body


if __name__ == "__main__":
    make(HERE)
