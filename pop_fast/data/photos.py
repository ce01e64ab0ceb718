"""Structure from motion: find the cameras of a bare folder of photographs with pycolmap, on the CPU.

SIFT features, exhaustive matching of up to 60 photographs (beyond that every photograph with its neighbours by name),
incremental mapping. Every random choice is seeded and the largest model is kept.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from pop_fast.data.capture import Progress
from pop_fast.data.colmap import quiet_colmap
from pop_fast.errors import CaptureError
from pop_fast.io.atomic import folder_atomically
from pop_fast.io.images import list_images, read_image

__all__ = ["SfmResult", "photo_folder", "run_sfm"]

_EXHAUSTIVE_UP_TO = 60
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
            beside the photographs: in the parent of a folder named `images`, else in `photo_dir` itself.
        progress: called with (stage, done, total) while features, matches and cameras are found.
        max_size: longest side at which features are looked for, px; cameras are always in full size.
        camera_model: COLMAP's name.
        single_camera: all photographs share one camera; by default when they are all of one size.
        seed: of every random choice.
        overwrite: replace an existing result.

    Raises:
        CaptureError: fewer than two photographs, a damaged one, or no model that holds two of them.
    """
    photos = Path(photo_dir)
    if not photos.is_dir():
        raise CaptureError(f"{photos}: no such folder; give the folder with the photographs")
    beside = photos.resolve().parent if photos.resolve().name == "images" else photos.resolve()
    capture = Path(out_dir) if out_dir is not None else beside
    names = [path.relative_to(photos) for path in list_images(photos) if path.relative_to(photos).parts[0] != "masks"]
    if len(names) < 2:
        raise CaptureError(f"{photos}: has {len(names)} photograph(s); a scene needs two or more that overlap")
    if single_camera is None:
        single_camera = len(_sizes(photos, names, progress)) == 1
    in_place = capture.resolve() == beside
    with folder_atomically(capture / "sparse" if in_place else capture, overwrite) as folder:
        model = folder / "0" if in_place else folder / "sparse" / "0"
        with tempfile.TemporaryDirectory(prefix="pop_sfm_") as work, quiet_colmap():
            job = _Job(photos, [name.as_posix() for name in names], Path(work), progress)
            _extract(job, camera_model, single_camera, max_size)
            _match(job, seed)
            best = _map(job, seed)
            model.mkdir(parents=True)
            best.write_binary(model)
        if not in_place:
            for name in names:
                (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(photos / name, folder / "images" / name)
    error = float(best.compute_mean_reprojection_error())
    return SfmResult(capture, best.num_reg_images(), len(names), best.num_points3D(), error)


@dataclass(frozen=True)
class _Job:
    photos: Path
    names: list[str]
    work: Path
    progress: Progress | None

    @property
    def database(self) -> Path:
        return self.work / "database.db"

    def count(self, table: str) -> int:
        """Count rows while COLMAP is writing them."""
        if not self.database.exists():
            return 0
        connection = sqlite3.connect(f"file:{self.database}?mode=ro", uri=True)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
        except sqlite3.OperationalError:  # not made yet, or locked
            return 0
        finally:
            connection.close()

    def run(self, stage: str, total: int, count: Callable[[], int], work: Callable[[Any], Any]) -> Any:
        """Run one step of COLMAP in a thread, telling its progress; an interrupt ends it."""
        token = pycolmap.CancellationToken()
        with ThreadPoolExecutor(max_workers=1) as pool:
            future = pool.submit(work, token)
            try:
                while not wait([future], timeout=0.3).done:
                    if self.progress is not None:
                        self.progress(stage, min(count(), total), total)
                result = future.result()
            except BaseException as error:
                token.cancel()
                if isinstance(error, ValueError | RuntimeError | IndexError | TypeError):
                    raise CaptureError(f"{self.photos}: {stage} failed: {error}") from error
                raise
        if self.progress is not None:
            self.progress(stage, total, total)
        return result


def _sizes(photos: Path, names: list[Path], progress: Progress | None) -> set[tuple[int, int]]:
    """Read all photographs once: damaged ones are found before the long work begins."""
    sizes: set[tuple[int, int]] = set()
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for done, shape in enumerate(pool.map(lambda name: read_image(photos / name).shape, names), start=1):
            sizes.add((shape[1], shape[0]))
            if progress is not None:
                progress("checking photographs", done, len(names))
    return sizes


def _extract(job: _Job, camera_model: str, single_camera: bool, max_size: int) -> None:
    if camera_model not in pycolmap.CameraModelId.__members__ or camera_model == "INVALID":
        known = ", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
        raise CaptureError(f"camera_model is {camera_model!r}; use one of {known}")
    reader = pycolmap.ImageReaderOptions(camera_model=camera_model)
    options = pycolmap.FeatureExtractionOptions(max_image_size=max_size)
    job.run(
        "finding features",
        len(job.names),
        lambda: job.count("keypoints"),
        lambda token: pycolmap.extract_features(
            job.database,
            job.photos,
            image_names=job.names,
            camera_mode=pycolmap.CameraMode.SINGLE if single_camera else pycolmap.CameraMode.AUTO,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
            cancellation_token=token,
        ),
    )


def _match(job: _Job, seed: int) -> None:
    n = len(job.names)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    exhaustive = n <= _EXHAUSTIVE_UP_TO
    pairing = pycolmap.SequentialPairingOptions()
    # neighbours, and with quadratic overlap those 2, 4, 8 ... further on
    pairs = n * (n - 1) // 2 if exhaustive else 2 * pairing.overlap * n

    def work(token: Any) -> None:
        common: dict[str, Any] = {
            "verification_options": verification,
            "device": pycolmap.Device.cpu,
            "cancellation_token": token,
        }
        if exhaustive:
            pycolmap.match_exhaustive(job.database, **common)
        else:
            pycolmap.match_sequential(job.database, pairing_options=pairing, **common)

    job.run("matching photographs", pairs, lambda: job.count("two_view_geometries"), work)


def _map(job: _Job, seed: int) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.min_model_size = min(options.min_model_size, 3)
    registered = [0]

    def advance(by: int) -> Callable[[], None]:
        def callback() -> None:
            registered[0] += by

        return callback

    out = job.work / "models"
    out.mkdir()
    models: dict[int, Any] = job.run(
        "finding cameras",
        len(job.names),
        lambda: registered[0],
        lambda token: pycolmap.incremental_mapping(
            job.database,
            job.photos,
            out,
            options=options,
            initial_image_pair_callback=advance(2),
            next_image_callback=advance(1),
            cancellation_token=token,
        ),
    )
    best = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)
    if best is None or best.num_reg_images() < 2 or best.num_points3D() == 0:
        raise CaptureError(f"{job.photos}: no cameras could be found for these {len(job.names)} photographs; {_FIX}")
    return best
