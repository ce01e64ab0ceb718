"""Every reader of the program, with the file of the corpus that is mutated for it.

A test (`tests/app/test_faults.py`) runs all of them on the sound files and holds what they have opened to what the
program's source opens: a new function that reads a file needs a reader here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from cuda_ext.gpu_check.__main__ import begun_report
from cuda_ext.gpu_check.outcomes import outcomes
from paper_repro import jobs, paper, prepared, results, scenes
from paper_repro.collect import collect
from paper_repro.jobs import job_named
from pop_fast.blocks.plan import read_job, read_plan
from pop_fast.blocks.rounds import own_of
from pop_fast.blocks.run import read_round
from pop_fast.cli import compare
from pop_fast.cli.data_check import look_over
from pop_fast.cli.render import listed_in
from pop_fast.data.load import load_capture, read_block
from pop_fast.data.sfm import recognise_result
from pop_fast.data.unpack import take_frames, unpack
from pop_fast.errors import CaptureError
from pop_fast.io.formats import load_splat_file
from pop_fast.io.image_header import can_read_heif, read_exif, read_size
from pop_fast.io.images import read_image, read_mask
from pop_fast.io.ply import read_points
from pop_fast.train import TrainConfig
from pop_fast.train import checkpoint as ckpt
from pop_fast.train.automatic import begun
from pop_fast.train.choose import choose_backend
from pop_fast.train.load_result import load_splat, read_record
from pop_fast.train.lpips import LPIPS
from pop_fast.train.results import read_config
from pop_fast.view.frames import exported_to
from pop_fast.view.live.draw import read_path
from pop_fast.view.paths import frames_in
from pop_fast.view.report.source import read_result
from pop_ref.conformance import vector_check
from pop_ref.conformance.scenes import load_scene
from pop_ref.learn.course import stage_named
from pop_ref.learn.progress import asked_before, course_map, state
from pop_ref.learn.student import borrowing, read_work


@dataclass(frozen=True)
class Reader:
    """A reader."""

    root: str  # what of the corpus it is given, a file or a folder; copied for it
    file: str  # that is mutated, relative to the root; "" is the root itself
    read: Callable[[Path], Any]  # given the copy
    # what lies around the content: "gzip", "zip" and "glb" are also taken off, and put on again with sound checksums
    # and lengths
    layer: Literal["plain", "gzip", "zip", "glb", "text"] = "plain"
    finite: bool = False  # whether all tensors that it returns must be
    refuses: bool = True  # whether it refuses anything; some do without what is damaged


def _splat(path: Path) -> dict[str, torch.Tensor]:
    return load_splat_file(path).params


def _photograph(path: Path) -> Any:
    # a header that tells nothing is no error; the decoder judges the file
    read_exif(path)
    read_size(path)
    return read_image(path)


def _capture(folder: Path) -> Any:
    return load_capture(str(folder))


def _block(folder: Path) -> Any:
    place = folder / "blocks" / "0_0"
    listing = read_block(place)
    with suppress(CaptureError):
        # what it says of a photograph or a mask that is listed names that file
        load_capture(str(place))
    return listing


def _sfm_list(folder: Path) -> Any:
    ours = recognise_result(folder, folder / "sparse")
    return [ours(path.relative_to(folder / "sparse")) for path in (folder / "sparse").rglob("*")]


def _film(path: Path) -> Any:
    frames_in(path)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        return take_frames(path, Path(folder) / "frames", 3)


def _archive(path: Path) -> Any:
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        return unpack(path, Path(folder) / "unpacked")


def _resumed(folder: Path) -> Any:
    begun(folder)
    return choose_backend(TrainConfig.of(result_dir=str(folder), backend="auto"), resume=True)


def _path(path: Path) -> Any:
    # as `pop render --path FILE` uses it
    return read_path(path).along(5, np.eye(4))


def _course(folder: Path) -> Any:
    work, stage = read_work(folder), stage_named("alpha")
    asked_before(folder, stage)
    return state(work, stage), course_map(work)


def _submission(folder: Path) -> Any:
    work, stage = read_work(folder), stage_named("alpha")
    with borrowing(work, (stage,)) as borrowed:
        return list(borrowed.installed)


def _row(path: Path) -> Any:
    return jobs.load_row(path.stem, path.parent), jobs.header_of(path.stem, path.parent)


def _collected(folder: Path) -> Any:
    return results.write(collect(job_named("pop", "demo", "toy"), folder, {}), folder / "results")


def _port(folder: Path) -> Any:
    return vector_check.check(folder, folder / "port").failed


def _layer(name: str) -> Literal["zip", "text"]:
    return "zip" if name.endswith(".npz") else "text"


_COLLECTED = (
    *("row.json", "probe.json", "metrics.jsonl", "stats/train_step0003.json", "stats/val_step0003.json"),
    "report_data/opacity_step3.npz",
)
_REPORTED = (
    *("metrics.jsonl", "commands.json", "stats/val_step0003.json", "report_data/checks_step3.json"),
    *(f"report_data/{name}.npz" for name in ("opacity_step-1", "val_step3_0000", "depth_step3_0000")),
)
_CKPT = "ckpts/ckpt_3_rank0.pt"
_SPLATS = {
    "PLY": Reader("splats/splat.ply", "", lambda path: load_splat(path).params, finite=True),
    "points of a PLY": Reader("splats/splat.ply", "", read_points),
    "compressed PLY": Reader("splats/compressed-ply.compressed.ply", "", _splat, finite=True),
    "SPZ": Reader("splats/spz.spz", "", _splat, "gzip", finite=True),
    "SPZ 4": Reader("splats/spz-4.spz", "", _splat, finite=True),
    "SOG": Reader("splats/sog.sog", "", _splat, "zip", finite=True),
    "SOG in a folder": Reader(
        "splats/sog", "meta.json", lambda folder: _splat(folder / "meta.json"), "text", finite=True
    ),
    **{f"KSPLAT {k}": Reader(f"splats/level_{k}.ksplat", "", _splat, finite=True) for k in range(3)},
    "splat": Reader("splats/splat.splat", "", _splat, finite=True),
    "glTF": Reader("splats/gltf.glb", "", _splat, "glb", finite=True),
    "glTF of SPZ": Reader("splats/gltf-spz.glb", "", _splat, "glb", finite=True),
}
_MODEL = ("cameras", "images", "points3D")
_CAPTURES = {
    **{f"COLMAP {name}.bin": Reader("colmap", f"sparse/0/{name}.bin", _capture) for name in _MODEL},
    **{f"COLMAP {name}.txt": Reader("colmap_text", f"sparse/0/{name}.txt", _capture, "text") for name in _MODEL},
    **{f"data check: sparse/0/{name}.bin": Reader("tracked", f"sparse/0/{name}.bin", look_over) for name in _MODEL},
    "data check: images/0.png": Reader("tracked", "images/0.png", look_over, refuses=False),
    "transforms.json": Reader("transforms", "transforms.json", _capture, "text"),
    "Metashape": Reader("metashape", "cameras.xml", _capture, "text"),
    "RealityCapture": Reader("realitycapture", "cameras.csv", _capture, "text"),
    "Polycam": Reader("polycam", "keyframes/cameras/1.json", _capture, "text"),
    "upright.json": Reader("upright", "sparse/upright.json", _capture, "text"),
    "sfm.sha256": Reader("upright", "sparse/sfm.sha256", _sfm_list, "text", refuses=False),
}
_PICTURES = {
    **{f"photograph.{kind}": Reader(f"photos/photo.{kind}", "", _photograph) for kind in ("png", "jpg", "webp", "tif")},
    "photograph.bmp": Reader("photos/photo.bmp", "", _photograph),
    "photograph of 16 bit": Reader("photos/deep.png", "", _photograph),
    "photograph with EXIF": Reader("photos/exif.jpg", "", _photograph),
    **({"photograph.heic": Reader("photos/photo.heic", "", _photograph)} if can_read_heif() else {}),
    "mask": Reader("photos/photo.png", "", read_mask),
    "archive of photographs": Reader("splats/sog.sog", "", _archive, "zip"),
    **{f"video.{kind}": Reader(f"films/film.{kind}", "", _film) for kind in ("avi", "mp4", "webm")},
}
_RUNS = {
    "checkpoint": Reader("result", _CKPT, lambda folder: ckpt.load_checkpoint(folder / _CKPT), "zip"),
    "splats of a checkpoint": Reader(
        "result", _CKPT, lambda folder: ckpt.load_splats(folder / _CKPT)[0], "zip", finite=True
    ),
    "weights of LPIPS": Reader("records/lpips.pt", "", lambda path: LPIPS("vgg", [path]), "zip"),
    "cfg.json": Reader("result", "cfg.json", read_config, "text"),
    "cfg.json of a run to resume": Reader("result", "cfg.json", _resumed, "text", refuses=False),
    "capture.json": Reader("result", "capture.json", read_record, "text"),
    **{f"report: {name}": Reader("result", name, read_result, _layer(name)) for name in _REPORTED},
    "compare": Reader("result", "stats/val_step0003.json", lambda folder: compare.run([str(folder)]), "text"),
    "camera path": Reader("records/path.json", "", _path, "text"),
    "renders.json": Reader(
        "records/renders.json", "", lambda path: listed_in(path.parent)(Path("0.png")), "text", refuses=False
    ),
    "cfg_args": Reader(
        "records/cfg_args", "", lambda path: exported_to(path.parent)(Path("cameras.json")), "text", refuses=False
    ),
}
_BLOCKS = {
    "block.json": Reader("blocked", "blocks/0_0/block.json", _block, "text"),
    "points of a block": Reader("blocked", "blocks/0_0/points.npz", _block, "zip"),
    "job.json": Reader("blocked", "blocks/job.json", read_job, "text"),
    "plan.json": Reader("blocked", "blocks/plan.json", read_plan, "text"),
    "stats.json of a round": Reader(
        "blocked", "blocks/round_0/stats.json", lambda folder: read_round(folder, 0), "text"
    ),
    "start.json": Reader("blocked", "blocks/round_1/0_0/start.json", lambda folder: own_of(folder, "0_0", 1), "text"),
}
_PAPER = {
    "results of a row": Reader(
        "records/full", "pop_size_prune.jsonl", lambda full: results.read_all("full", full.parent), "text"
    ),
    "row": Reader("records/pop.toml", "", _row, "text"),
    "scene of the paper": Reader("records/fox.toml", "", scenes.load_scene, "text"),
    "paper.toml": Reader("records/paper.toml", "", paper.load, "text"),
    "prepared capture": Reader("prepared/prepared_1.npz", "", lambda path: prepared.read(path, TrainConfig()), "zip"),
    **{f"collected: {name}": Reader("result", name, _collected, _layer(name)) for name in _COLLECTED},
}
_KIT = {
    "vectors: index.json": Reader("vectors", "index.json", _port, "text"),
    "vectors: a vector": Reader("vectors", "pop_loss_some_important.npz", _port, "zip"),
    "vectors: a result": Reader("vectors", "port/pop_loss_some_important.npz", _port, "zip"),
    "vectors: a result as JSON": Reader("vectors", "port/loss_l1.json", _port, "text"),
    "scene": Reader("scenes/scene.npz", "", load_scene, "zip"),
    "learn: progress": Reader("course", ".progress.json", _course, "text"),
    "learn: a submission": Reader("course", "alpha.py", _course, "text", refuses=False),
    "learn: a submission that is run": Reader("course", "alpha.py", _submission, "text"),
    "GPU check: report": Reader("records/gpu_check_1.json", "", begun_report, "text", refuses=False),
    "GPU check: outcomes": Reader("records/laws.jsonl", "", outcomes, "text", refuses=False),
}
READERS: dict[str, Reader] = {**_SPLATS, **_PICTURES, **_CAPTURES, **_RUNS, **_BLOCKS, **_PAPER, **_KIT}
