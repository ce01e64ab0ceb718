"""Structure from motion: find the cameras of a bare folder of photographs with pycolmap, on the CPU.

SIFT features, exhaustive matching of up to 60 photographs (beyond that every photograph with its neighbours by name),
incremental mapping. Every random choice is seeded and the largest model is kept.
"""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pop_fast.data.capture import Progress
from pop_fast.data.colmap import quiet_colmap
from pop_fast.data.pinhole import require_colmap
from pop_fast.data.sfm_files import recognise_result, write_list
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.images import list_images, read_image, unreadable_photographs
from pop_fast.io.jpeg import sound_jpegs

__all__ = ["SfmResult", "photo_folder", "photographs", "run_sfm"]

_EXHAUSTIVE_UP_TO = 60
_NEIGHBOURS = 10
# photographs, and the square of it pairs, between two reports of progress
_BATCH = 8
_FIX = "take photographs that overlap by two thirds, from different places, of a scene with texture"


@dataclass(frozen=True)
class SfmResult:
    """What structure from motion found.

    Attributes:
        capture: the folder that `load_capture` reads.
        registered: photographs whose camera was found.
        photographs: photographs that were given.
        points: sparse points.
        reprojection_error: mean, px.
    """

    capture: Path
    registered: int
    photographs: int
    points: int
    reprojection_error: float


def photo_folder(root: Path) -> Path:
    """Find the photographs of a capture without cameras: its folder `images`, or the capture itself."""
    return root / "images" if (root / "images").is_dir() else root


def photographs(folder: Path) -> list[Path]:
    """List the photographs of a folder and its subfolders, sorted by relative name; `masks` holds none."""
    return [path for path in list_images(folder) if path.relative_to(folder).parts[0] != "masks"]


def run_sfm(
    photo_dir: str | Path,
    out_dir: str | Path | None = None,
    progress: Progress | None = None,
    *,
    max_size: int = 1600,
    camera_model: str = "SIMPLE_RADIAL",
    single_camera: bool | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> SfmResult:
    """Find cameras and sparse points, and write them as a COLMAP capture, whole or not at all.

    Args:
        photo_dir: the photographs, in subfolders too.
        out_dir: the capture to make, with copies of the photographs in `images`. Without it, `sparse/0` is written
            beside the photographs: in the parent of a folder named `images`, else in `photo_dir` itself; and there too
            where `photo_dir` is given as `out_dir`.
        progress: called with (stage, done, total) while features, matches and cameras are found.
        max_size: longest side at which features are looked for, px; cameras are always in full size.
        camera_model: COLMAP's name.
        single_camera: all photographs share one camera; by default when they are all of one size.
        seed: of every random choice.
        overwrite: replace an existing result, where it is nothing but that.

    Raises:
        CaptureError: fewer than two photographs, a damaged one, no model that holds two of them, or a result that would
            take the place of photographs or of files that are not its own.
    """
    photos = Path(photo_dir)
    if not photos.is_dir():
        raise CaptureError(f"{photos}: no such folder; give the folder with the photographs")
    capture, target = _place(photos, out_dir)
    names = [path.relative_to(photos) for path in photographs(photos) if not path.resolve().is_relative_to(target)]
    if len(names) < 2:
        hint = unreadable_photographs(photos) or "a scene needs two or more that overlap"
        raise CaptureError(f"{photos}: has {len(names)} photograph(s); {hint}")
    if single_camera is None:
        single_camera = len(_sizes(photos, names, progress)) == 1
    in_place = target != capture.resolve()
    own = recognise_result(capture.resolve(), target)
    with folder_atomically(target, overwrite, recognise=own) as folder:
        sparse = folder if in_place else folder / "sparse"
        with tempfile.TemporaryDirectory(prefix="pop_sfm_") as work, quiet_colmap():
            job = _Job(photos, _stage(photos, names, Path(work)), Path(work), progress)
            best = _find_cameras(job, camera_model, single_camera, max_size, seed)
            for image in best.images.values():
                image.name = names[int(Path(image.name).stem)].as_posix()
            (sparse / "0").mkdir(parents=True)
            best.write_binary(sparse / "0")
        if not in_place:
            for name in names:
                (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(photos / name, folder / "images" / name)
        write_list(sparse, folder, "sparse/" if in_place else "")
    error = float(best.compute_mean_reprojection_error())
    return SfmResult(capture, best.num_reg_images(), len(names), best.num_points3D(), error)


def _place(photos: Path, out_dir: str | Path | None) -> tuple[Path, Path]:
    """Say where the capture is made, and which folder is replaced for it: `sparse` in place, else the whole capture."""
    given = photos.resolve()
    beside = given.parent if given.name == "images" else given
    capture = Path(out_dir) if out_dir is not None else beside
    in_place = capture.resolve() in (beside, given)
    if not in_place and given.is_relative_to(capture.resolve()):
        raise CaptureError(
            f"{capture}: holds the photographs of {photos}, which a new capture there would replace; "
            "choose another --out, or none to write sparse/0 beside them"
        )
    target = capture.resolve() / "sparse" if in_place else capture.resolve()
    return capture, target


@dataclass(frozen=True)
class _Job:
    photos: Path
    names: list[str]  # in `work / "images"`
    work: Path
    progress: Progress | None

    @property
    def database(self) -> Path:
        return self.work / "database.db"

    def tell(self, stage: str, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress(stage, done, total)


def _stage(photos: Path, names: list[Path], work: Path) -> list[str]:
    """Give photographs plain numbers for names, because COLMAP's lists of pairs cannot hold a space."""
    (work / "images").mkdir()
    staged = [f"{i:06d}{name.suffix.lower()}" for i, name in enumerate(names)]
    for name, plain in zip(names, staged, strict=True):
        try:
            (work / "images" / plain).symlink_to((photos / name).resolve())
        except OSError:  # where links need a privilege
            shutil.copyfile(photos / name, work / "images" / plain)
    return staged


def _sizes(photos: Path, names: list[Path], progress: Progress | None) -> set[tuple[int, int]]:
    """Read all photographs once: damaged ones are found before the long work begins."""
    sizes: set[tuple[int, int]] = set()
    files = [photos / name for name in names]
    with sound_jpegs(files), ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for done, shape in enumerate(pool.map(lambda file: read_image(file).shape, files), start=1):
            sizes.add((shape[1], shape[0]))
            if progress is not None:
                progress("checking photographs", done, len(names))
    return sizes


def _find_cameras(job: _Job, camera_model: str, single_camera: bool, max_size: int, seed: int) -> Any:
    try:
        _extract(job, camera_model, single_camera, max_size)
        _match(job, seed)
        return _map(job, seed)
    except CaptureError:
        raise
    except (ValueError, RuntimeError, IndexError, TypeError) as error:
        raise CaptureError(f"{job.photos}: COLMAP failed: {error}; {_FIX}") from error


def _extract(job: _Job, camera_model: str, single_camera: bool, max_size: int) -> None:
    """Find features, a few photographs at a time, so that progress can be told and an interrupt is heard."""
    pycolmap = require_colmap()
    if camera_model not in pycolmap.CameraModelId.__members__ or camera_model == "INVALID":
        known = ", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
        raise CaptureError(f"camera_model is {camera_model!r}; use one of {known}")
    n = len(job.names)
    # listed first and in order, because the threads that find features would number photographs as they finish
    pycolmap.Database.open(job.database).close()
    pycolmap.import_images(
        job.database,
        job.work / "images",
        camera_mode=pycolmap.CameraMode.SINGLE if single_camera else pycolmap.CameraMode.AUTO,
        image_names=job.names,
        options=pycolmap.ImageReaderOptions(camera_model=camera_model),
    )
    for start in range(0, n, _BATCH):
        job.tell("finding features", start, n)
        pycolmap.extract_features(
            job.database,
            job.work / "images",
            image_names=job.names[start : start + _BATCH],
            extraction_options=pycolmap.FeatureExtractionOptions(max_image_size=max_size),
            device=pycolmap.Device.cpu,
        )
    job.tell("finding features", n, n)


def _pairs(n: int) -> list[tuple[int, int]]:
    """List which photographs to match: all with all, or each with its neighbours by name, near and 2^k further on."""
    if n <= _EXHAUSTIVE_UP_TO:
        return list(itertools.combinations(range(n), 2))
    steps = {*range(1, _NEIGHBOURS + 1), *(2**k for k in range(_NEIGHBOURS))}
    return sorted((i, i + step) for i in range(n) for step in steps if i + step < n)


def _match(job: _Job, seed: int) -> None:
    pycolmap = require_colmap()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairs = _pairs(len(job.names))
    listing = job.work / "pairs.txt"
    for start in range(0, len(pairs), _BATCH**2):
        job.tell("matching photographs", start, len(pairs))
        batch = pairs[start : start + _BATCH**2]
        listing.write_text("".join(f"{job.names[i]} {job.names[j]}\n" for i, j in batch), encoding="utf-8")
        pycolmap.match_image_pairs(
            job.database,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listing),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    job.tell("matching photographs", len(pairs), len(pairs))


def _map(job: _Job, seed: int) -> Any:
    pycolmap = require_colmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.min_model_size = 3
    # bundle adjustment adds in the order in which its threads finish: one thread gives the same bits every time
    options.num_threads = 1
    options.mapper.num_threads = 1
    options.ba_min_num_residuals_for_cpu_multi_threading = 2**31 - 1
    found = [0]

    def advance(by: int) -> Callable[[], None]:
        def callback() -> None:
            found[0] += by
            job.tell("finding cameras", min(found[0], len(job.names)), len(job.names))

        return callback

    job.tell("finding cameras", 0, len(job.names))
    out = job.work / "models"
    out.mkdir()
    models: dict[int, Any] = pycolmap.incremental_mapping(
        job.database,
        job.work / "images",
        out,
        options=options,
        initial_image_pair_callback=advance(2),
        next_image_callback=advance(1),
    )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
    if best is None or best.num_reg_images() < 2 or best.num_points3D() == 0:
        raise CaptureError(f"{job.photos}: no cameras could be found for these {len(job.names)} photographs; {_FIX}")
    return best
