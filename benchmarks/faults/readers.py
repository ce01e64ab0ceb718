"""Every reader of the program, with the file of the corpus that is mutated for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from pop_fast.data.load import load_capture
from pop_fast.io.formats import load_splat_file
from pop_fast.io.image_header import read_exif, read_size
from pop_fast.io.images import read_image, read_mask
from pop_fast.io.points import read_points
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.load_result import read_record
from pop_fast.train.results import read_config
from pop_fast.view.report.source import read_result


@dataclass(frozen=True)
class Reader:
    """A reader.

    Attributes:
        root: what of the corpus it is given, a file or a folder; copied for it.
        file: that is mutated, relative to the root; "" is the root itself.
        read: given the copy.
        layer: what lies around the content: "gzip", "zip" and "glb" are also taken off, and put on again with sound
            checksums and lengths.
        finite: whether all tensors that it returns must be.
    """

    root: str
    file: str
    read: Callable[[Path], Any]
    layer: Literal["plain", "gzip", "zip", "glb", "text"] = "plain"
    finite: bool = False


def _splat(path: Path) -> dict[str, torch.Tensor]:
    return load_splat_file(path).params


def _sog_folder(folder: Path) -> dict[str, torch.Tensor]:
    return load_splat_file(folder / "meta.json").params


def _photograph(path: Path) -> Any:
    # a header that tells nothing is no error; the decoder judges the file
    read_exif(path)
    read_size(path)
    return read_image(path)


def _capture(folder: Path) -> Any:
    return load_capture(str(folder))


def _checkpoint(folder: Path) -> Any:
    return ckpt.load_checkpoint(ckpt.checkpoint_path(folder, 3))


def _splats_of_checkpoint(folder: Path) -> dict[str, torch.Tensor]:
    return ckpt.load_splats(ckpt.checkpoint_path(folder, 3))[0]


_CKPT = "ckpts/ckpt_3_rank0.pt"
READERS: dict[str, Reader] = {
    "PLY": Reader("splats/splat.ply", "", _splat, finite=True),
    "points of a PLY": Reader("splats/splat.ply", "", read_points),
    "compressed PLY": Reader("splats/compressed-ply.compressed.ply", "", _splat, finite=True),
    "SPZ": Reader("splats/spz.spz", "", _splat, "gzip", finite=True),
    "SPZ 4": Reader("splats/spz-4.spz", "", _splat, finite=True),
    "SOG": Reader("splats/sog.sog", "", _splat, "zip", finite=True),
    "SOG in a folder": Reader("splats/sog", "meta.json", _sog_folder, "text", finite=True),
    **{f"KSPLAT {k}": Reader(f"splats/level_{k}.ksplat", "", _splat, finite=True) for k in range(3)},
    "splat": Reader("splats/splat.splat", "", _splat, finite=True),
    "glTF": Reader("splats/gltf.glb", "", _splat, "glb", finite=True),
    "glTF of SPZ": Reader("splats/gltf-spz.glb", "", _splat, "glb", finite=True),
    "checkpoint": Reader("result", _CKPT, _checkpoint, "zip"),
    "splats of a checkpoint": Reader("result", _CKPT, _splats_of_checkpoint, "zip", finite=True),
    **{
        f"COLMAP {name}.bin": Reader("colmap", f"sparse/0/{name}.bin", _capture)
        for name in ("cameras", "images", "points3D")
    },
    **{
        f"COLMAP {name}.txt": Reader("colmap_text", f"sparse/0/{name}.txt", _capture, "text")
        for name in ("cameras", "images", "points3D")
    },
    "transforms.json": Reader("transforms", "transforms.json", _capture, "text"),
    **{f"photograph.{kind}": Reader(f"photos/photo.{kind}", "", _photograph) for kind in ("png", "jpg", "webp", "tif")},
    "photograph.bmp": Reader("photos/photo.bmp", "", _photograph),
    "mask": Reader("photos/photo.png", "", read_mask),
    "cfg.json": Reader("result", "cfg.json", read_config, "text"),
    "capture.json": Reader("result", "capture.json", read_record, "text"),
    **{
        f"report: {name}": Reader("result", name, read_result, kind)  # type: ignore[arg-type]
        for name, kind in (
            ("metrics.jsonl", "text"),
            ("stats/val_step0003.json", "text"),
            ("report_data/opacity_step-1.npz", "zip"),
            ("report_data/val_step3_0000.npz", "zip"),
        )
    },
}
