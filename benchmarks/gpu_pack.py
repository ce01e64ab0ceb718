"""Make what a bare GPU node cannot fetch: trained scenes as npz, shrunk captures, wheels, and a list of all of it.

    python benchmarks/gpu_pack.py FOLDER [--runs out/garden_pop ...] [--captures data/garden ...] [--pixels 400000]
                                         [--whole data/garden ...] [--prepared fox bear_512 --data data]

`python3 -m cuda_ext.gpu_check --pack FOLDER` runs this; its help says what the folder holds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from cuda_ext.gpu_check.__main__ import commit_of
from cuda_ext.gpu_check.shared import ROOT, write_json
from paper_repro import prepared
from paper_repro.jobs import Job, load_row
from paper_repro.scenes import SCALES, SCENES, find_folder
from paper_repro.train_row import load_capture_of
from pop_fast.children import python_command
from pop_fast.data import Capture, View, load_capture
from pop_fast.errors import PopError
from pop_fast.train.load_result import CaptureOptions, load_splat, open_capture

LIMIT: Final = 64 * 2**20  # bytes that travel, with the repository's own files
QUALITY: Final = 92  # of a photograph's JPEG
MOST_POINTS: Final = 100_000  # of a capture
# pure Python, by the names that pip knows them by; gsplat compiles its kernels where it is installed
WHEELS: Final = ("beartype", "plyfile", "tyro", "typeguard", "docstring-parser", "typing-extensions", "jaxtyping")
WHEELS += ("wadler-lindig", "gsplat")


def pack_scene(run: Path, folder: Path) -> Path:
    """Write a result of `pop train` as a packed scene: its last checkpoint, its held-out cameras, the first photograph.

    Raises:
        PopError: it is no result, its capture is not where it was, or another of its name is packed.
    """
    splat = load_splat(run)
    capture, config = open_capture(splat, CaptureOptions())
    views = capture.test_views(config.test_every) or capture.views
    p = {name: value.numpy() for name, value in splat.params.items()}
    sh = np.zeros((len(p["means"]), 16, 3), np.float16)
    sh[:, :1], sh[:, 1 : 1 + p["shN"].shape[1]] = p["sh0"], p["shN"]
    target = _target(folder, f"{run.resolve().name}.npz")
    np.savez_compressed(
        target,
        means=p["means"],
        quats=p["quats"],
        scales=np.exp(p["scales"]),
        opacities=1.0 / (1.0 + np.exp(-p["opacities"])),
        sh=sh,
        viewmats=np.stack([view.viewmat for view in views]).astype(np.float32),
        Ks=np.stack([view.K for view in views]).astype(np.float32),
        sizes=np.array([(view.width, view.height) for view in views], np.int32),
        photograph=views[0].image,
    )
    return target


def pack_capture(source: Path, folder: Path, pixels: float) -> Path:
    """Write a capture with photographs of at most so many pixels, undistorted, as JPEG with a COLMAP text model.

    Raises:
        PopError: the capture cannot be read, or another of its name is packed.
    """
    target = _target(folder, source.resolve().name)
    capture = load_capture(source, masks=False, normalize=False)
    (target / "images").mkdir(parents=True)
    (target / "sparse" / "0").mkdir(parents=True)
    cameras: list[str] = []
    images: list[str] = []
    for k, view in enumerate(capture.views, start=1):
        name = f"{k:04d}.jpg"
        image, K = _shrunk(view, pixels)
        cv2.imwrite(str(target / "images" / name), image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        high, wide = image.shape[:2]
        lens = " ".join(map(repr, [*np.diag(K)[:2].tolist(), *K[:2, 2].tolist()]))
        cameras.append(f"{k} PINHOLE {wide} {high} {lens}")
        x, y, z, w = Rotation.from_matrix(view.viewmat[:3, :3]).as_quat().tolist()
        place = " ".join(map(repr, [w, x, y, z, *view.viewmat[:3, 3].tolist()]))
        # every camera has a line of observations, which is empty
        images.append(f"{k} {place} {k} {name}\n")
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", _points(capture))):
        (target / "sparse" / "0" / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return target


def keep_capture(source: Path, folder: Path) -> Path:
    """Copy a capture as it is, of which rows of the paper's tables can be trained.

    Raises:
        PopError: it cannot be read, or another of its name is packed.
    """
    target = _target(folder, source.resolve().name)
    load_capture(source)
    shutil.copytree(source, target)
    return target


def prepare_capture(name: str, data: Path, folder: Path) -> Path:
    """Write what rows of the paper's tables see of a scene, at the scale that decides claims.

    Raises:
        PopError: there is no such scene, it cannot be read, or its points depend on the seed of a row.
    """
    if name not in SCENES:
        raise PopError(f"there is no scene {name!r}; they are {', '.join(SCENES)}")
    scene, scale = SCENES[name], SCALES["small"]
    captures: list[Capture] = []
    for seed in (0, 1):
        job = Job(load_row("pop"), scene, scale, seed)
        config = job.config(data=str(find_folder(scene, data)), result_dir=str(folder), progress=False)
        captures.append(load_capture_of(job, config)[0])
    if not np.array_equal(captures[0].points, captures[1].points):
        raise PopError(f"{name}: has no points of its own; those that are made up depend on the seed")
    return prepared.write(captures[0], config, folder / scene.folder)


def _target(folder: Path, name: str) -> Path:
    """Return where a source is packed; a second one of the same name would be mixed with the first."""
    if (folder / name).exists():
        raise PopError(f"another {name} is packed already; rename one of the two")
    return folder / name


def _shrunk(view: View, pixels: float) -> tuple[np.ndarray, np.ndarray]:
    by = min(1.0, math.sqrt(pixels / (view.width * view.height)))
    size = (max(round(by * view.width), 1), max(round(by * view.height), 1))
    K = view.K.copy()
    if by == 1.0:
        return view.image, K
    K[:2] *= np.array([size[0] / view.width, size[1] / view.height])[:, None]
    return cv2.resize(view.image, size, interpolation=cv2.INTER_AREA), K


def _points(capture: Capture) -> list[str]:
    """Write the points without tracks, evenly thinned where there are very many."""
    n = len(capture.points)
    kept = np.linspace(0, n - 1, min(n, MOST_POINTS)).astype(np.int64)
    rows = zip(capture.points[kept].tolist(), capture.points_rgb[kept].tolist(), strict=True)
    return [f"{k} {x:.6g} {y:.6g} {z:.6g} {r} {g} {b} 0" for k, ((x, y, z), (r, g, b)) in enumerate(rows, start=1)]


def fetch_wheels(folder: Path) -> list[str]:
    """Download the wheels, each for itself; return what could not be had."""
    absent: list[str] = []
    folder.mkdir(parents=True, exist_ok=True)
    for name in WHEELS:
        pip = python_command("-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:")
        done = subprocess.run([*pip, "-d", str(folder), name], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            words = done.stderr.strip().splitlines() or ["no words"]
            absent.append(f"{name}: {words[-1]}")
    for wheel in folder.glob("*.whl"):
        if not wheel.name.endswith("-none-any.whl"):
            absent.append(f"{wheel.name}: is not pure Python, and may not run on the node")
            wheel.unlink()
    return absent


def write_manifest(folder: Path, absent: list[str]) -> int:
    """List every file with its size and digest; return the bytes of the pack and of the repository together."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "manifest.json")
    listed = {
        path.relative_to(folder).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        }
        for path in files
    }
    packed, own = sum(entry["bytes"] for entry in listed.values()), _repository_bytes()
    versions = {"python": platform.python_version(), "numpy": np.__version__}
    content = {"commit": commit_of(None), "packed_bytes": packed, "repository_bytes": own, "limit_bytes": LIMIT}
    write_json(folder / "manifest.json", {**content, "made_with": versions, "absent": absent, "files": listed})
    return packed + own


def _repository_bytes() -> int:
    """Add up what git tracks, or where there is no git everything but what was built."""
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        paths = [ROOT / name for name in done.stdout.split("\0") if name]
    else:
        paths = [p for p in ROOT.rglob("*") if not {"out", "build", ".venv"} & set(p.relative_to(ROOT).parts)]
    return sum(path.stat().st_size for path in paths if path.is_file())


def _make_anew(folder: Path) -> None:
    """Empty the folder of an earlier pack, or make it.

    Raises:
        PopError: it is a file, holds what no pack has, or cannot be made.
    """
    try:
        if folder.exists() and any(folder.iterdir()) and not (folder / "manifest.json").is_file():
            raise PopError(f"{folder}: holds files that no pack has; name another folder")
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "scenes").mkdir(parents=True)
    except OSError as error:
        raise PopError(f"{folder}: {error.strerror}; name another folder") from error
    # a pack that is interrupted is known for one by the next call
    write_json(folder / "manifest.json", {})


def main() -> int:
    """Pack from the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="is made anew; it must not hold anything else")
    parser.add_argument("--runs", nargs="*", type=Path, default=[], help="results of `pop train`")
    parser.add_argument("--captures", nargs="*", type=Path, default=[], help="captures to train on")
    parser.add_argument("--whole", nargs="*", type=Path, default=[], help="captures that keep their bytes, for rows")
    parser.add_argument("--prepared", nargs="*", default=[], metavar="SCENE", help="scenes as rows see them, in a file")
    parser.add_argument("--data", type=Path, default=Path("data"), help="the folder that holds these scenes")
    parser.add_argument("--pixels", type=float, default=4e5, help="of a packed photograph, at most")
    parser.add_argument("--no-wheels", action="store_true", help="download nothing")
    args = parser.parse_args()
    folder: Path = args.folder
    try:
        if not args.pixels >= 1.0:
            raise PopError(f"--pixels is {args.pixels:g}; it must be at least 1")
        _make_anew(folder)
    except PopError as error:
        print(f"gpu_pack: {error}", file=sys.stderr)
        return 2
    absent: list[str] = []
    scenes, captures = folder / "scenes", folder / "captures"
    packed: tuple[tuple[str, list[Path], Callable[[Path], Path]], ...] = (
        ("run", args.runs, lambda source: pack_scene(source, scenes)),
        ("capture", args.captures, lambda source: pack_capture(source, captures, args.pixels)),
        ("capture", args.whole, lambda source: keep_capture(source, captures)),
        ("scene", list(map(Path, args.prepared)), lambda name: prepare_capture(str(name), args.data, captures)),
    )
    for what, sources, pack in packed:
        for source in sources:
            try:
                print(f"{what} {source}: {pack(source).relative_to(folder)}")
            except PopError as error:
                absent.append(f"{what} {source}: {error}")
    absent += [] if args.no_wheels else fetch_wheels(folder / "wheels")
    total = write_manifest(folder, absent)
    for words in absent:
        print(f"gpu_pack: absent: {words}", file=sys.stderr)
    print(json.dumps({"packed with the repository, MiB": round(total / 2**20, 1), "of": LIMIT // 2**20}))
    if total > LIMIT:
        print("gpu_pack: too much to travel: pack fewer captures, or smaller photographs (--pixels)", file=sys.stderr)
        return 1
    return 1 if absent else 0


if __name__ == "__main__":
    sys.exit(main())
