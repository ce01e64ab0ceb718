"""The files that the fuzzer starts from: one small sound file of each kind that the program reads.

They are kept in `corpus.zip`, so that a number names the same input everywhere, and unpacked into the folder `corpus`,
which git ignores, when this module is imported. `python -m benchmarks.faults.corpus` makes them anew, which changes
what every number means. `corpus/regressions` holds inputs that once broke something, each in a folder named after its
reader; they are read as they are, before anything is mutated.

KSPLAT, which the program only reads, is written here by its description.
Source: https://github.com/mkkellogg/GaussianSplats3D, src/loaders/SplatBuffer.js.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import os
import shutil
import struct
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import torch

from paper_repro import prepared
from pop_fast.blocks.plan import Job, job_text, make_plan, write_plan
from pop_fast.data.capture import Listing
from pop_fast.data.colmap import read_model
from pop_fast.data.load import load_capture
from pop_fast.data.sfm import UPRIGHT, write_list
from pop_fast.io.formats import FORMATS, encoded
from pop_fast.io.image_header import can_read_heif
from pop_fast.io.ply import Frame, save_ply
from pop_fast.train import TrainConfig, TrainingRun
from pop_fast.train.load_result import RECORD, CaptureRecord, cameras_of, record_text
from pop_fast.view.live.draw import KeyCamera, path_of
from pop_fast.view.report.checks import Checks
from pop_ref.conformance.scenes import save_scene
from pop_ref.conformance.vectors import export

ARCHIVE = Path(__file__).resolve().with_name("corpus.zip")
# next to the files: the digest of the archive that they are from
_STAMP = ".archive"
WIDTH, HEIGHT, FOCAL, VIEWS, POINTS = 24, 16, 20.0, 3, 12

_COLUMNS = ("x", "y", "z", "red", "green", "blue")
_PROTOCOL = {"split": "every 3rd by name", "test_views": 1, "images": "images", "factor": 1, "width": WIDTH}
_PROTOCOL |= {"height": HEIGHT, "resize": "area"}


def unpacked(archive: Path = ARCHIVE) -> Path:
    """Unpack the archive into the folder of its name, where that holds another one's files, and return the folder."""
    folder = archive.with_suffix("")
    with open(archive, "rb") as file:
        # one process unpacks while others wait
        fcntl.flock(file, fcntl.LOCK_EX)
        digest = hashlib.sha256(file.read()).hexdigest()
        stamp = folder / _STAMP
        if not stamp.exists() or stamp.read_text(encoding="utf-8") != digest:
            shutil.rmtree(folder, ignore_errors=True)
            with zipfile.ZipFile(file) as members:
                members.extractall(folder)
            stamp.write_text(digest, encoding="utf-8")
    return folder


def pack(folder: Path, archive: Path = ARCHIVE) -> None:
    """Write the archive from the folder; the same files give the same bytes."""
    beside = archive.with_suffix(".part")
    with zipfile.ZipFile(beside, "w") as members:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.name != _STAMP:
                entry = zipfile.ZipInfo(path.relative_to(folder).as_posix())
                members.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    os.replace(beside, archive)
    (folder / _STAMP).write_text(hashlib.sha256(archive.read_bytes()).hexdigest(), encoding="utf-8")


HERE = unpacked()


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


def _write_binary(model: Path, tracked: bool = False) -> None:
    """Write a model; where it is not `tracked`, its tracks are not those that COLMAP itself would accept."""
    seen = range(1, POINTS + 1) if tracked else [1]
    camera = struct.pack("<QiiQQdddd", 1, 1, 1, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
    (model / "cameras.bin").write_bytes(camera)
    images = struct.pack("<Q", VIEWS)
    for view in range(VIEWS):
        pose = (1.0, 0.0, 0.0, 0.0, 0.1 * view, 0.0, 0.0)
        images += struct.pack("<i7di", view + 1, *pose, 1) + f"{view}.png\0".encode() + struct.pack("<Q", len(seen))
        images += b"".join(struct.pack("<ddq", 3.0, 4.0, number) for number in seen)
    (model / "images.bin").write_bytes(images)
    points = struct.pack("<Q", POINTS)
    for number, xyz in enumerate(_points(), 1):
        places = [(view + 1, number - 1) for view in range(VIEWS)] if tracked else [(1, 0)]
        points += struct.pack("<Q3d3BdQ", number, *xyz, 200, 100, 50, 0.5, len(places))
        points += b"".join(struct.pack("<ii", *place) for place in places)
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
        images="images",
        missing="error",
        masks=True,
        source="auto",
        world_transform=np.eye(4).tolist(),
        cameras=cameras_of(load_capture(str(capture))),
    )
    (folder / RECORD).write_text(record_text(record))
    # where it was made is nobody's business
    path = folder / "cfg.json"
    path.write_text(path.read_text().replace(str(folder), "result"))


def _few_gaussians() -> dict[str, torch.Tensor]:
    random = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (15, 3)}
    return {key: 0.5 * torch.randn((3, *shape), generator=random) for key, shape in shapes.items()}


def _write_splats(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    params = _few_gaussians()
    turned = ((0.0, -2.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0))
    save_ply(folder / "splat.ply", params, frame=Frame("training", turned, (("profile", "inria"), ("eps2d", 0.1))))
    for name, format in FORMATS.items():
        if name != "ply":
            (folder / f"{name}{format.suffix}").write_bytes(encoded(name, params))


def make_more(folder: Path) -> None:
    """Write the files that are made of the others, and those of formats that came later."""
    _write_later_splats(folder / "splats")
    _write_pictures(folder)
    _write_exports(folder)
    _write_blocks(folder)
    _write_records(folder / "result", folder / "records")
    _write_prepared(folder / "prepared", folder / "tracked")
    _write_vectors(folder / "vectors")
    _write_kit(folder)


def _write_later_splats(folder: Path) -> None:
    with zipfile.ZipFile(folder / "sog.sog") as archive:
        archive.extractall(folder / "sog")
    for level in range(3):
        (folder / f"level_{level}.ksplat").write_bytes(ksplat_of(_few_gaussians(), level))


def _write_pictures(folder: Path) -> None:
    picture, photos = _photograph(0), folder / "photos"
    cv2.imwrite(str(photos / "deep.png"), picture.astype(np.uint16) * 257)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    exif = b"Exif\0\0" + _exif()
    (photos / "exif.jpg").write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif + data[2:])
    if can_read_heif():
        import pillow_heif

        rgb = np.ascontiguousarray(picture[..., ::-1])
        file = pillow_heif.from_bytes(mode="RGB", size=(WIDTH, HEIGHT), data=rgb.tobytes())
        file.save(photos / "photo.heic", quality=80, exif=exif)
    films = folder / "films"
    films.mkdir(exist_ok=True)
    for name, code in (("film.avi", "MJPG"), ("film.mp4", "mp4v"), ("film.webm", "VP80")):
        film = cv2.VideoWriter(str(films / name), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), 5.0, (WIDTH, HEIGHT))
        for view in range(6):
            film.write(_photograph(view))
        film.release()


def _exif() -> bytes:
    """Return TIFF tags: a maker, an orientation, and in their own directory an exposure time and a focal length."""
    tags = struct.pack("<HHHII", 3, 0x10F, 2, 4, int.from_bytes(b"pop\0", "little"))
    tags += struct.pack("<HHII", 0x112, 3, 1, 1) + struct.pack("<HHIII", 0x8769, 4, 1, 50, 0)
    own = struct.pack("<HHHIIHHIII", 2, 0x829A, 5, 1, 80, 0x920A, 5, 1, 88, 0)
    return b"II*\0" + struct.pack("<I", 8) + tags + own + struct.pack("<IIII", 1, 125, 24, 1)


def _write_exports(folder: Path) -> None:
    for name in ("metashape", "realitycapture", "polycam", "upright", "tracked"):
        shutil.rmtree(folder / name, ignore_errors=True)
    shutil.copytree(folder / "colmap", folder / "tracked")
    _write_binary(folder / "tracked" / "sparse" / "0", tracked=True)
    for name in ("metashape", "realitycapture"):
        shutil.copytree(folder / "colmap" / "images", folder / name / "images")
    (folder / "metashape" / "cameras.xml").write_text(_metashape())
    head = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n"
    rows = [f"{view}.png,{0.1 * view},0,2,0,90,0,30,0,0,0,0,0,0,0,0\n" for view in range(VIEWS)]
    (folder / "realitycapture" / "cameras.csv").write_text(head + "".join(rows))
    keyframes = folder / "polycam" / "keyframes"
    shutil.copytree(folder / "colmap" / "images", keyframes / "images")
    (keyframes / "cameras").mkdir()
    for view in range(VIEWS):
        pose = {
            f"t_{i}{j}": float(i == j) + (0.1 * view if (i, j) == (0, 3) else 0.0) for i in range(3) for j in range(4)
        }
        lens = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
        (keyframes / "cameras" / f"{view}.json").write_text(json.dumps({**lens, **pose}))
    # without points, thousands would be made at random for every input
    points = "".join(f"{x} {y} {z} 200 100 50\n" for x, y, z in _points())
    columns = "".join(
        f"property {kind} {name}\n" for kind, name in zip(("float",) * 3 + ("uchar",) * 3, _COLUMNS, strict=True)
    )
    for name in ("metashape", "realitycapture", "polycam", "transforms"):
        head = f"ply\nformat ascii 1.0\nelement vertex {POINTS}\n{columns}end_header\n"
        (folder / name / "points3D.ply").write_text(head + points)
    shutil.copytree(folder / "colmap", folder / "upright")
    (folder / "upright" / "sparse" / UPRIGHT).write_text(json.dumps({"1.png": 2}))
    write_list(folder / "upright" / "sparse", folder / "upright" / "sparse", "sparse/")


def _metashape() -> str:
    lens = f"<f>{FOCAL}</f><cx>0</cx><cy>0</cy><k1>0.01</k1>"
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    lens = f'<calibration type="frame" class="adjusted">{size}{lens}</calibration>'
    sensor = f'<sensor id="0" type="frame">{size}{lens}</sensor>'
    poses = [f"1 0 0 {0.1 * view} 0 1 0 0 0 0 1 0 0 0 0 1" for view in range(VIEWS)]
    cameras = [
        f'<camera id="{view}" sensor_id="0" label="{view}.png"><transform>{pose}</transform></camera>'
        for view, pose in enumerate(poses)
    ]
    frame = (
        "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>1</scale></transform>"
    )
    return (
        f'<document version="1.5"><chunk><sensors>{sensor}</sensors><cameras>{"".join(cameras)}</cameras>{frame}'
        "</chunk></document>\n"
    )


def _write_blocks(folder: Path) -> None:
    """Divide the capture; the blocks name it from the repository's root, where the fuzzer runs."""
    place, capture = folder / "blocked", folder / "colmap"
    shutil.rmtree(place, ignore_errors=True)
    job = Job(blocks="2x1", rounds=1, round_steps=2)
    loaded = load_capture(str(capture))
    shots, cloud = read_model(capture / "sparse" / "0")
    plan = make_plan(loaded, job, 3)
    listing = Listing(capture, capture, shots, cloud, "colmap")
    write_plan(place, plan, listing, np.asarray(loaded.world_transform))
    (place / "blocks" / "job.json").write_text(job_text(job))
    for path in place.rglob("block.json"):
        path.write_text(path.read_text().replace(str(capture.absolute()), "benchmarks/faults/corpus/colmap"))
    row = {"name": "0_0", "num_GS": 12, "seconds": 1.0, "seconds_total": 2.0, "memory_bytes": 10**8}
    (place / "blocks" / "round_0").mkdir()
    (place / "blocks" / "round_0" / "stats.json").write_text(json.dumps({"round": 0, "psnr": 20.0, "blocks": [row]}))
    merged = place / "blocks" / "round_1" / "0_0"
    merged.mkdir(parents=True)
    (merged / "start.json").write_text(json.dumps({"own": 3, "fixed": 2, "merged": 5}))


def _write_records(result: Path, folder: Path) -> None:
    """Write what a result holds besides a run's first files, and records of other commands."""
    step = 3
    (result / "commands.json").write_text(json.dumps([{"words": ["pop", "train", "colmap"], "folder": "."}], indent=2))
    (result / "row.json").write_text(json.dumps({"data_hash": "0" * 64, "commit": "0" * 40, **_PROTOCOL}))
    (result / "probe.json").write_text(json.dumps({"0": {"num_gaussians": 12, "grad_l1": 0.5}}))
    checks = Checks(2, 20.0, 2, 19.0, 19.5, 5.0, {"0.png": 0.25}, {"0.png": 0.5})
    (result / "report_data" / f"checks_step{step}.json").write_text(json.dumps(asdict(checks), indent=2))
    np.savez_compressed(
        result / "report_data" / f"depth_step{step}_0000.npz", name="0.png", depth=np.ones((4, 6), np.float32)
    )
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    cameras = [KeyCamera(np.eye(4), 0.9), KeyCamera(np.eye(4) + np.eye(4, k=3) * 0.5, 0.8)]
    (folder / "path.json").write_text(path_of(cameras, np.eye(4)).text())
    (folder / "renders.json").write_text(json.dumps({"renders": [{"view": "0.png", "file": "0.png"}]}))
    (folder / "cfg_args").write_text("Namespace(eval=True, exported_by='pop export')")
    (folder / "gpu_check_1.json").write_text(json.dumps({"job": 1, "stages": {"build": {"status": 0, "seconds": 1.0}}}))
    laws = [{"test": "a", "outcome": "passed", "seconds": 0.1, "words": ""}]
    laws += [{"test": "b", "outcome": "skipped", "seconds": 0.0, "words": "no GPU"}]
    (folder / "laws.jsonl").write_text("".join(f"{json.dumps(law)}\n" for law in laws))
    torch.save({"lin0.model.1.weight": torch.ones(1, 64, 1, 1)}, folder / "lpips.pt")
    repro = HERE.parents[2] / "paper_repro"
    (folder / "full").mkdir()
    found = json.loads((repro / "results" / "full" / "pop_size_prune.jsonl").read_text().splitlines()[0])
    # short: a few points of the curve say what all do
    found["curve"] = [{name: [*column[:1], *column[-2:]] for name, column in table.items()} for table in found["curve"]]
    (folder / "full" / "pop_size_prune.jsonl").write_text(json.dumps(found, separators=(",", ":")) + "\n")
    shutil.copy(repro / "configs" / "pop.toml", folder / "pop.toml")
    shutil.copy(repro / "scenes" / "fox.toml", folder / "fox.toml")
    shutil.copy(repro / "paper.toml", folder / "paper.toml")


def _write_prepared(folder: Path, capture: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    prepared.write(load_capture(capture), TrainConfig(), folder)


def _write_vectors(folder: Path) -> None:
    """Write vectors of a few kinds, and the results of a port that is right, as npz and as JSON."""
    shutil.rmtree(folder, ignore_errors=True)
    with tempfile.TemporaryDirectory() as place:
        export(Path(place))
        index = json.loads((Path(place) / "index.json").read_text())
        names = ("pop_loss_some_important", "loss_l1")
        index["vectors"] = {name: index["vectors"][name] for name in names}
        index["kinds"] = {kind: index["kinds"][kind] for kind in ("pop", "loss")}
        (folder / "port").mkdir(parents=True)
        (folder / "index.json").write_text(json.dumps(index, indent=1))
        for name in names:
            shutil.copy(Path(place) / f"{name}.npz", folder)
    for name, vector in index["vectors"].items():
        arrays = index["kinds"][vector["kind"]]["arrays"]
        with np.load(folder / f"{name}.npz") as stored:
            found = {array: stored[array] for array in arrays if arrays[array]["role"] == "output" and array in stored}
        if name == "loss_l1":
            text = json.dumps({array: np.asarray(value).tolist() for array, value in found.items()})
            (folder / "port" / f"{name}.json").write_text(text)
        else:
            np.savez(folder / "port" / f"{name}.npz", **found)


def _write_kit(folder: Path) -> None:
    from pop_ref.conformance.vector_scenes import vector_scenes
    from pop_ref.learn.course import COURSE, stage_named
    from pop_ref.learn.stubs import answer, start

    save_scene(folder / "scenes" / "scene.npz", next(iter(vector_scenes().values())))
    shutil.rmtree(folder / "course", ignore_errors=True)
    start(folder / "course")
    stage = stage_named("alpha")
    for other in COURSE:
        if other != stage:
            (folder / "course" / other.file).unlink()
    path = folder / "course" / stage.file
    head = path.read_text().partition('"""\n')[2].partition("\ndef ")[0]
    path.write_text(f"{head}\n{answer(stage)}\n")
    (folder / "course" / ".progress.json").write_text(json.dumps({"passed": {"alpha": "0" * 64}, "asked": ["alpha"]}))


if __name__ == "__main__":
    make(HERE)
    make_more(HERE)
    pack(HERE)


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
